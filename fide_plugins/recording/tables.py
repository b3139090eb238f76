"""The two tables of a run, as text: every evaluation, and those that were the best so far."""

from __future__ import annotations

import csv
import io

import numpy as np

from fide_plugins.recording.parallel import WORKERS, rounds
from fide_plugins.recording.record import Record, best_so_far

__all__ = ["curve", "improvements"]


def curve(record: Record) -> str:
    """`curve.csv`: one line for each evaluation."""
    losses, seconds = np.array(record.losses), np.array(record.seconds)
    rows = zip(losses.tolist(), best_so_far(losses).tolist(), seconds.tolist(), strict=True)
    lines = ["evaluation,loss,best_loss,seconds"]
    lines += [f"{i},{loss!r},{b!r},{s:.4f}" for i, (loss, b, s) in enumerate(rows)]
    return "\n".join(lines) + "\n"


def improvements(record: Record) -> str:
    """`improvements.csv`; what a metric that raised has not measured is empty."""
    in_round = rounds(record.generations)
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")  # names of losses may need quoting
    names = ["evaluation", "seconds", f"round_of_{WORKERS}", "loss", *record.metrics]
    writer.writerow(names)
    for k, i in enumerate(record.improvements):
        others = (repr(v[k]) if k < len(v) else "" for v in record.metrics.values())
        where = [i, f"{record.seconds[i]:.4f}", in_round[i]]
        writer.writerow([*where, repr(record.losses[i]), *others])
    return buffer.getvalue()
