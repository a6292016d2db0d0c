import numpy as np
import pytest

from datagen.errors import InputError
from fusion.pose_benchmark import measures
from fusion.pose_benchmark.case_files import (
    CaseResult,
    Cost,
    NearestFound,
    PoseErrors,
    case_file,
    read_case,
    write_case,
)
from fusion.pose_benchmark.protocol import TRIAL_NAMES, parse_trials, trials_of

EYE = np.eye(4).tolist()


def case(rotation_deg=0.1, translation_m=0.001, *, add_m=0.001, nearest=None, failure=None, identity="a", **errors):
    found = PoseErrors(rotation_deg=rotation_deg, translation_m=translation_m, add_m=add_m, add_s_m=add_m / 2, **errors)
    return CaseResult(
        subject="ball",
        trial="clean",
        frame=3,
        repeat=0,
        identity=identity,
        diameter_m=0.5,
        truth=EYE,
        errors=None if failure else found,
        nearest=nearest,
        failure=failure,
        verdict=None if failure else "found",
        cost=Cost(processor_s=0.2, wall_s=0.1),
    )


def nearest(distance, least=0.1):
    cost = Cost(processor_s=0.01, wall_s=0.03)
    return NearestFound(frame=1, distance=distance, least_distance=least, ambiguous=False, cost=cost)


def test_medians_are_in_degrees_and_millimetres():
    cases = [case(1.0, 0.001), case(2.0, 0.002), case(9.0, 0.5)]
    assert measures.median_rotation().measure(cases) == 2.0
    assert measures.median_translation().measure(cases) == pytest.approx(2.0)


def test_what_was_not_found_counts_as_infinitely_wrong():
    cases = [case(0.1, 0.001), case(failure="no depth"), case(failure="no depth")]
    assert measures.median_rotation().measure(cases) is None
    strict = measures.within_bounds(centimetres=1, degrees=1)
    assert strict.measure(cases) == pytest.approx(100 / 3)
    assert measures.add_within(0.1).measure(cases) == pytest.approx(100 / 3)


def test_shares_are_of_cases_below_their_bound():
    cases = [case(0.5, 0.004), case(1.5, 0.004), case(0.5, 0.02), case(0.5, 0.009)]
    assert measures.within_bounds(centimetres=1, degrees=1).measure(cases) == 50
    cases = [case(add_m=0.0499), case(add_m=0.0501)]  # a tenth of the diameter is 0.05
    assert measures.add_within(0.1).measure(cases) == 50
    assert measures.add_s_within(0.05).measure(cases) == 50
    cases = [case(projection_px=4.9), case(projection_px=None), case(projection_px=5.1), case(projection_px=0.1)]
    assert measures.projection_within(5).measure(cases) == 50


def test_a_view_within_a_tenth_of_the_least_distance_counts_as_nearest():
    cases = [case(nearest=nearest(d)) for d in (0.1, 0.1099, 0.112, 0.5)]
    assert measures.nearest_found().measure(cases) == 50
    assert measures.nearest_found().measure([*cases, *4 * [case(failure="no depth")]]) == 25
    assert measures.nearest_found().measure([case()]) is None


def test_times_are_the_lesser_of_clock_and_processor():
    assert measures.refinement_time().measure([case()]) == pytest.approx(100)
    assert measures.nearest_time().measure([case(nearest=nearest(1))]) == pytest.approx(10)


def test_bop_recalls_average_over_their_thresholds():
    vsd, mssd, mspd = measures.bop_recalls(width_px=320)
    # 0.12 diameters are less than eight of 0.05 … 0.5; 4 pixels of 320 less than nine of 2.5 … 25.
    one = case(mssd_m=0.06, mspd_px=4.0, vsd=tuple(0.33 for _ in range(10)))
    assert mssd.measure([one]) == pytest.approx(80)
    assert mspd.measure([one]) == pytest.approx(90)
    assert vsd.measure([one]) == pytest.approx(40)
    assert vsd.measure([one, case(failure="no depth")]) == pytest.approx(20)


def test_a_bar_is_passed_at_its_bound():
    bar = measures.median_rotation(at_most=0.5)
    assert bar.passes(0.5)
    assert not bar.passes(0.51)
    assert measures.nearest_found(at_least=99).passes(99)
    assert measures.median_rotation().passes(1e9) is None
    assert bar.wording == "≤ 0.5 °"


def test_the_bars_are_those_that_were_asked_for():
    bars = {
        (trial.name, bar.what): bar.at_most if bar.at_least is None else bar.at_least
        for kind in ("object", "room", "points")
        for trial in trials_of(kind, width_px=640)
        for bar in trial.bars
    }
    asked = {
        ("clean", "nearest view found"): 99,
        ("noisy", "nearest view found"): 97,
        ("clean", "median rotation"): 0.05,
        ("clean", "median translation"): 0.1,
        ("clean", "within 1 cm 1°"): 100,
        ("clean", "ADD-0.01d"): 99,
        ("mask", "median rotation"): 0.5,
        ("mask", "median translation"): 2,
        # Of a query without depth, whether it has colours beside its mask or not.
        ("color", "median rotation"): 0.5,
        ("color", "median translation"): 2,
        ("off-10", "within 1 cm 1°"): 99,
        ("off-40", "within 1 cm 1°"): 95,
        ("noisy", "within 1 cm 1°"): 90,
        ("noisy", "ADD-0.1d"): 99.9,
        ("noisy", "5 px projection"): 99.5,
        ("real", "ADD-S-0.1d"): 100,
        ("real", "median rotation that the shape fixes"): 3,
        ("depth", "within 5 cm 5°"): 99,
        ("depth", "median rotation"): 0.5,
        ("depth", "median translation"): 10,
        ("clean", "time, nearest view"): 20,
        ("clean", "time, refinement"): 150,
    }
    assert {key: bar for key, bar in bars.items() if bar is not None} == asked


def test_trials_that_there_are_not_are_refused():
    assert parse_trials(None) is None
    assert parse_trials("mask,clean") == ("mask", "clean")
    for text in ("clan", "", "clean,"):
        with pytest.raises(InputError, match="expected some of clean, mask"):
            parse_trials(text)
    assert len(set(TRIAL_NAMES)) == len(TRIAL_NAMES)


def test_a_result_is_read_back_unless_it_is_damaged_or_of_another_case(tmp_path):
    path = case_file(tmp_path, "ball", "clean", 3, 0)
    assert read_case(path, identity="a") is None
    result = case(nearest=nearest(0.2), vsd=(0.5,) * 10)
    write_case(path, result)
    assert read_case(path, identity="a") == result
    assert read_case(path, identity="b") is None
    path.write_text(path.read_text()[:-20])
    assert read_case(path, identity="a") is None
