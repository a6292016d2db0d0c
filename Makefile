# make demo   render Suzanne, fuse, locate, and open it all in Blender: the folder demo/
# make test   install what the tests need, and run them
# make lint   format, lint and type-check
#
# make extension        the Blender extension's zips, one for each platform, wheels and all: the folder dist/
# make test-extension   this platform's zip, installed into Blender's Python module
# make test-gui         the same zip in a Blender with an interface, on a virtual display (Debian, root, debootstrap)
#
# Blender's Python module exists for Python 3.11 (Blender 4.5, 5.0) and 3.13 (5.1 and later).

PYTHON ?= $(shell command -v python3.11 || command -v python3.13 || echo python3)
VENV ?= .venv
DEMO ?= demo
RUN := $(VENV)/bin/python -m

.PHONY: demo test lint extension test-extension test-blender test-gui clean system-libraries
.DELETE_ON_ERROR:

demo: $(DEMO)/comparison.png
	@echo "Open $(DEMO)/result.blend in Blender, or look at $(DEMO)/preview.png and $(DEMO)/comparison.png"

# A complete dataset is left as it is, and with it the folder's date: then nothing below is made again.
$(DEMO)/dataset/frames: $(VENV)/blender.installed scenes/suzanne.toml FORCE
	$(RUN) datagen render suzanne $(DEMO)/dataset --frames 60

$(DEMO)/reconstruction.json: $(DEMO)/dataset/frames
	$(RUN) fusion reconstruct $(DEMO)/dataset $(DEMO) --frames ::2

$(DEMO)/poses.json: $(DEMO)/reconstruction.json
	$(RUN) fusion locate $(DEMO) $(DEMO)/dataset --frames 5::10

# result.blend and preview.png are there when this last one is.
$(DEMO)/comparison.png: $(DEMO)/poses.json
	$(RUN) blender_addon $(DEMO)

test: $(VENV)/dev.installed
	$(RUN) pytest -n auto --dist loadfile

# CI changes nothing: there, what is not formatted fails.
lint: $(VENV)/dev.installed
	$(RUN) ruff format $(if $(CI),--check) .
	$(RUN) ruff check .
	$(RUN) mypy

extension: $(VENV)/dev.installed
	$(RUN) blender_addon.packaging

# Kept apart from the quick suite: they download some 300 MB, and a Blender of 2 GB.
test-extension: $(VENV)/dev.installed
	SCANBACK_TEST_WHEELS=1 $(RUN) pytest tests/blender_addon/test_zip_with_wheels.py

# What the quick suite has no time for of the extension's steps.
test-blender: $(VENV)/dev.installed
	$(RUN) pytest -m slow tests/blender_addon

test-gui: $(VENV)/dev.installed
	SCANBACK_TEST_GUI=1 $(RUN) pytest tests/gui

clean:
	rm -rf $(VENV) $(DEMO) build dist *.egg-info

system-libraries:
	@sh .ci/system-libraries.sh $(PYTHON)

$(VENV)/bin/python: | system-libraries
	$(PYTHON) -m venv $(VENV)

$(VENV)/blender.installed: pyproject.toml | $(VENV)/bin/python
	$(VENV)/bin/pip install --quiet --editable '.[blender]'
	@touch $@

$(VENV)/dev.installed: pyproject.toml | $(VENV)/bin/python
	$(VENV)/bin/pip install --quiet --editable '.[blender,dev]'
	@touch $@ $(VENV)/blender.installed

FORCE:
