from support.paper import paper

from fgtrack.pipeline.effective import effective


def test_the_paper_shifts_its_detections_and_merges_and_the_run_says_so() -> None:
    assert str(effective(paper())) == (
        "detection origin -1.74 m ahead, 0 m left of the ego; merge up to 5.1 m; lag 3.5 s"
    )
    smoother = effective(paper("estimator=smoother", "motion.kind=ctrv", "smoother.late=fuse"))
    assert (smoother.lag_s, smoother.reach_s) == (1.0, 3.0)
    assert str(smoother).endswith("lag 1 s, late detections up to 3 s")
    drops = effective(paper("estimator=smoother-banded", "motion.kind=ctrv", "smoother.late=drop"))
    assert (drops.lag_s, drops.reach_s) == (1.0, 1.0)
