"""Tables of decisions: revisions by late data, and errors by wrong decisions."""

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

from fgtrack.evaluation.metrics import Metrics
from fgtrack.evaluation.scores.decisions import RECENT_S
from fgtrack.evaluation.tables import PERCENT, RUN, Column, Table


def revisions_table(metrics: Mapping[str, Metrics]) -> Table:
    """Return a table with the decisions and states of each run that late data has changed.

    It is empty if no run has a changed decision, a compared state or a withdrawn state.
    """
    records = []
    for label, item in metrics.items():
        of = item.revisions
        record = {
            each.name: getattr(of, each.name)
            for each in fields(of)
            if each.name != "time_to_final_s"
        }
        time_s = of.time_to_final_s
        record |= {
            "revised_share": of.revised_share,
            "moved_share": of.moved_share,
            "time_to_final_p50_s": time_s.p50,
            "time_to_final_p99_s": time_s.p99,
            "time_to_final_max_s": time_s.max,
        }
        records.append({"run": label, **record})
    if not any(
        each["changes"] or each["compared_states"] or each["withdrawn_states"]
        for each in records
    ):
        records = []
    columns = [
        RUN,
        Column("revised\ndetections", "revised_detections"),
        Column("share\n[%]", "revised_share", scale=PERCENT),
        Column("other\ntrack", "other_track"),
        Column("new\ntrack", "new_track"),
        Column("no\ntrack", "no_track"),
        Column(
            "final after\n[s] p50/max",
            "time_to_final_p50_s time_to_final_max_s",
            "{}/{}",
        ),
        Column("moved\nstates", "moved_states"),
        Column("share\n[%]", "moved_share", scale=PERCENT),
        Column("withdrawn\nstates", "withdrawn_states"),
    ]
    notes = [
        "revised: late data has changed the track of the detection; final after: from its arrival to its last change",
        "moved: the later position at the same stamp is outside of the published 95 % ellipse; 5 % are expected",
        "withdrawn: in the end, the track does not exist at the stamp of the state, or was never confirmed",
    ]
    revised = any(record["changes"] for record in records)
    title = "Revisions (what was taken back)"
    return Table(title, records, columns, notes=notes, is_detail=not revised)


def decisions_table(metrics: Mapping[str, Metrics]) -> Table:
    """Return a table with the wrong decisions of each run with truth.

    It also divides the position error into a part of the estimates and a part of the wrong decisions.
    """
    records = []
    for label, item in metrics.items():
        of = item.decisions
        if of is None:
            continue
        record: dict[str, Any] = {"run": label}
        for name, each in (
            ("at_arrival", of.at_arrival),
            ("in_the_end", of.in_the_end),
        ):
            record |= {f"{kind}_{name}": n for kind, n in vars(each).items()}
            record |= {f"wrong_share_{name}": each.wrong_share}
        for name, part in (("present", of.present), ("final", of.final)):
            record |= {f"{name}_{key}": value for key, value in vars(part).items()}
        records.append(record)
    columns = [RUN]
    for name in ("at_arrival", "in_the_end"):
        words = name.replace("_", " ")
        columns.append(
            Column(f"wrong\n{words} [%]", f"wrong_share_{name}", scale=PERCENT)
        )
    for kind in ("other_object", "clutter", "without_track"):
        words = kind.replace("_", " ")
        names = f"{kind}_at_arrival {kind}_in_the_end"
        columns.append(Column(f"{words}\narrival/end", names, "{}/{}"))
    for name in ("present", "final"):
        columns += [
            Column(f"{name}\nhit [%]", f"{name}_hit_share", scale=PERCENT),
            Column(f"{name}\nestim. [m²]", f"{name}_estimation_m2"),
            Column(f"{name}\nassoc. [m²]", f"{name}_association_m2"),
        ]
    notes = [
        "wrong: decisions about detections, against the nearest true object; arrival, end: before and after revisions",
        f"hit: states whose track has a detection of something else, at most {RECENT_S:g} s away",
        "estim.: mean squared error of the other states; assoc.: what the hit states add to the mean squared error",
    ]
    title = "Decisions and estimates (their parts in the errors)"
    return Table(title, records, columns, notes=notes, is_detail=True)
