import pytest
from hypothesis import given
from hypothesis import strategies as st

from datagen.errors import InputError
from datagen.frame_selection import select_frames

FRAMES = tuple(range(0, 1000, 5))
bounds = st.none() | st.integers(-250, 250)


@given(bounds, bounds, st.none() | st.integers(1, 30))
def test_a_selection_is_a_python_slice(start, stop, step):
    text = ":".join("" if part is None else str(part) for part in (start, stop, step))
    wanted = FRAMES[slice(start, stop, step)]
    if wanted:
        assert select_frames(FRAMES, text) == wanted
    else:
        with pytest.raises(InputError, match="selects none"):
            select_frames(FRAMES, text)


@pytest.mark.parametrize("index", [0, 7, -1, -200])
def test_one_number_takes_one_frame(index):
    assert select_frames(FRAMES, str(index)) == (FRAMES[index],)


def test_nothing_said_takes_all():
    assert select_frames(FRAMES, None) == FRAMES


@pytest.mark.parametrize("text", ["", "a:b", "1:2:3:4", "1-5", "::0", "200", "-201"])
def test_anything_else_is_refused(text):
    with pytest.raises(InputError, match="--frames"):
        select_frames(FRAMES, text)
