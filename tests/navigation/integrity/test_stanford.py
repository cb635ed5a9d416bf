"""Classes of the Stanford diagram, at their borders."""

import numpy as np
import pytest

from napf_mpc.navigation.integrity.stanford import Integrity, classify, count_classes


def test_classes_at_their_borders() -> None:
    limit = 10.0
    cases = [
        (3.0, 5.0, Integrity.NOMINAL),
        (5.0, 5.0, Integrity.NOMINAL),
        (10.0, 10.0, Integrity.NOMINAL),
        (6.0, 5.0, Integrity.MISLEADING),
        (10.0, 5.0, Integrity.MISLEADING),
        (10.1, 5.0, Integrity.HAZARDOUS),
        (-10.1, 5.0, Integrity.HAZARDOUS),
        (10.1, 10.0, Integrity.HAZARDOUS),
        (3.0, 12.0, Integrity.UNAVAILABLE),
        (11.0, 12.0, Integrity.UNAVAILABLE),
        (13.0, 12.0, Integrity.UNAVAILABLE_MISLEADING),
        (3.0, np.inf, Integrity.NONE),
        (3.0, np.nan, Integrity.NONE),
        (np.nan, 5.0, Integrity.NONE),
    ]
    error, level, kinds = (np.array(column) for column in zip(*cases, strict=True))
    codes = classify(error, level, limit)
    assert [Integrity(c) for c in codes] == [Integrity(k) for k in kinds]
    count = count_classes(codes)
    assert (count.total, count.misleading) == (11, 6)
    assert count.by_class[Integrity.HAZARDOUS] == 3


@pytest.mark.parametrize("limit", [0.0, -1.0, np.inf, np.nan])
def test_an_alert_limit_is_a_length(limit: float) -> None:
    with pytest.raises(ValueError, match="alert_limit_m"):
        classify(np.ones(1), np.ones(1), limit)
