"""Campaigns of one airframe that contradict each other are reported with the numbers that show it."""

from aerpaw_cmp.compare.calibration import Score
from aerpaw_cmp.jobs.calibrate import _contradictions


def score(flight: str, rmse_db: float) -> Score:
    return Score(flight, "LW1", "A", rmse_db, rmse_db, 6.0, 9.0, 6.5, 100)


def test_a_campaign_that_another_airframe_predicts_worse_than_free_space_is_named() -> None:
    campaigns = {"a": "good", "b": "bad", "c": "turned"}
    scores = [score("a", 5.0), score("b", 6.4), score("c", 5.5)]
    controls = {"rotated by 90 deg": [score("a", 7.0), score("b", 7.0), score("c", 5.1)], "world frame": []}
    said = _contradictions(scores, controls, campaigns)
    assert [text.split()[0] for text in said] == ["bad", "turned"]
    assert "RMSE 6.40 dB with their airframe, 7.00 dB with this airframe rotated, 6.00 dB in free space" in said[0]
