"""What a person sees who installs the zip and opens the tab."""


def test_the_tab_opens_with_its_steps(desktop):
    seen = desktop.run("import_session.py")
    assert seen["enabled"]
    assert seen["tab"] == "Scanback"
