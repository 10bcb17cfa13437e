"""The recorded episodes of tests/golden, played again.

On one machine the bits are the same; other processors and compilers round differently, so positions may differ by 5 mm,
coverage by half a percent, what exploring and overlap earn by 0.02, the other terms by 0.001. Poses diverge over time,
hence the few steps.
"""

import numpy as np
import pytest
from golden.record import CASES, FOLDER, play

TOLERANCE = {
    "pose": 5e-3, "path_length": 5e-3, "coverage": 5e-3, "terms": [2e-2, 2e-2, 1e-3, 1e-3, 1e-3],
    "pictures": 0.3, "team": 0.3,
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_an_episode_is_as_it_was(case):
    with np.load(FOLDER / f"{case}.npz") as file:
        golden = dict(file)
    now, advice = play(case), "if that is meant, run python -m tests.golden.record and say why in the commit"
    assert golden.keys() == now.keys()
    for name, values in golden.items():
        off = np.abs(now[name] - values) > TOLERANCE[name] + 1e-3 * np.abs(values)
        assert not off.any(), f"{case}: {name} changed in {off.sum()} of {off.size} values; {advice}"


def test_the_records_are_small_and_none_is_left_over():
    files = sorted(FOLDER.glob("*.npz"))
    assert [file.stem for file in files] == sorted(CASES)
    assert sum(file.stat().st_size for file in files) < 200_000


@pytest.mark.parametrize("case", CASES)
def test_a_record_holds_something(case):
    """Robots drive, see and are rewarded in it."""
    with np.load(FOLDER / f"{case}.npz") as file:
        assert (file["path_length"][-1] > 0.2).any() and (np.diff(file["coverage"], axis=0) >= 0).all()
        assert (file["terms"][..., 0] > 0).any() and np.isfinite(file["pose"]).all()
