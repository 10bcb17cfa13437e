"""The recorded episodes of tests/golden, played again.

On one machine the bits are the same; other processors and compilers round differently, so positions may differ by 5 mm,
coverage by half a percent, what exploring and overlap earn by 0.02, the other terms by 0.001. Poses diverge over time,
hence the few steps.

Records are as wide as the tables were when they were made: a reward term or a channel that has come since is not
compared, nor is a scenario without a record, until `python -m tests.golden.record` is run.
"""

import numpy as np
import pytest
from golden.record import CASES, FOLDER, play

from maexp.envs.specs import REWARD_TERMS

TERM_TOLERANCE = [2e-2 if term in ("explore", "overlap") else 1e-3 for term in REWARD_TERMS]
TOLERANCE = {"pose": 5e-3, "path_length": 5e-3, "coverage": 5e-3, "pictures": 0.3, "team": 0.3}
GROWING = ("terms", "pictures", "team")
"""Their last axis may have grown since: new terms and channels come last."""
RECORDED = sorted(file.stem for file in FOLDER.glob("*.npz"))


@pytest.mark.parametrize("case", RECORDED)
def test_an_episode_is_as_it_was(case):
    with np.load(FOLDER / f"{case}.npz") as file:
        golden = dict(file)
    now, advice = play(case), "if that is meant, run python -m tests.golden.record and say why in the commit"
    assert golden.keys() == now.keys()
    for name, values in golden.items():
        again = now[name][..., : values.shape[-1]] if name in GROWING else now[name]
        assert again.shape == values.shape, f"{case}: {name}"
        tolerance = TERM_TOLERANCE[: values.shape[-1]] if name == "terms" else TOLERANCE[name]
        off = np.abs(again - values) > tolerance + 1e-3 * np.abs(values)
        assert not off.any(), f"{case}: {name} changed in {off.sum()} of {off.size} values; {advice}"


def test_the_records_are_small_and_none_is_left_over():
    assert set(RECORDED) <= set(CASES) and len(RECORDED) >= 10, "a record without a case, or one that is missing"
    assert sum(file.stat().st_size for file in FOLDER.glob("*.npz")) < 20_000 * len(RECORDED)


@pytest.mark.parametrize("case", RECORDED)
def test_a_record_holds_something(case):
    """Robots drive, see and are rewarded in it."""
    with np.load(FOLDER / f"{case}.npz") as file:
        assert (file["path_length"][-1] > 0.2).any() and (np.diff(file["coverage"], axis=0) >= 0).all()
        assert (file["terms"][..., 0] > 0).any() and np.isfinite(file["pose"]).all()
