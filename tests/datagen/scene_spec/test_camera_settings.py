import json

import numpy as np
import pytest
from pydantic import ValidationError

from datagen.scene_spec.camera_settings import CameraSettings
from datagen.scene_spec.render_settings import PRESETS, RenderSettings


def settings(**values):
    return CameraSettings.model_validate_json(json.dumps(values))


def test_the_matrix_is_taken_as_it_is_and_survives_being_stored():
    declared = settings(intrinsics_px=[525, 520.5, 319.5, 239.25])
    camera = declared.pinhole((640, 480))
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (525, 520.5, 319.5, 239.25)
    assert CameraSettings.model_validate_json(declared.model_dump_json()) == declared
    assert CameraSettings.model_validate_json(CameraSettings().model_dump_json()) == CameraSettings()


def test_a_field_of_view_spans_the_fitted_side():
    for fit, size, side in [("horizontal", (640, 480), 640), ("vertical", (640, 480), 480), ("auto", (48, 64), 64)]:
        camera = settings(field_of_view_deg=90, sensor_fit=fit).pinhole(size)
        assert camera.fx == pytest.approx(side / 2), fit
        assert camera.fy == pytest.approx(camera.fx)


def test_a_shift_moves_the_principal_point_by_a_share_of_the_fitted_side():
    camera = settings(shift_x=0.1, shift_y=0.05).pinhole((640, 480))
    np.testing.assert_allclose([camera.cx, camera.cy], [319.5 - 64, 239.5 + 32])


def test_wide_pixels_shorten_fx_against_fy():
    camera = settings(pixel_aspect=2.0).pinhole((640, 480))
    assert camera.fy == pytest.approx(2 * camera.fx)


@pytest.mark.parametrize(
    ("values", "complaint"),
    [
        ({"focal_length_mm": 35, "field_of_view_deg": 60}, "give one of .* not focal_length_mm and field_of_view_deg"),
        ({"intrinsics_px": [500, 500, 320, 240], "shift_x": 0.1}, "leave shift_x, shift_y and pixel_aspect out"),
        ({"intrinsics_px": [0, 500, 320, 240]}, "greater than 0"),
        ({"stereo_baseline": -0.1}, "greater than 0"),
        ({"clip_start": 5, "clip_end": 2}, "clip_end"),
    ],
)
def test_what_says_a_thing_twice_or_cannot_be_is_refused(values, complaint):
    with pytest.raises(ValidationError, match=complaint):
        settings(**values)


def test_every_preset_is_a_valid_setting_and_they_cost_more_from_draft_to_high():
    settings_of = [RenderSettings.model_validate(preset) for preset in PRESETS.values()]
    costs = [(each.samples, each.bounces, each.denoise) for each in settings_of]
    assert list(PRESETS) == ["draft", "standard", "high"]
    assert costs == sorted(set(costs))


def test_the_order_of_layers_makes_no_other_recipe():
    one = RenderSettings.model_validate({"layers": ["masks", "flow", "masks"]})
    assert one == RenderSettings.model_validate({"layers": ["flow", "masks"]})
