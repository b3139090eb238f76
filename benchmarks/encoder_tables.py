"""The tables of lab/reports/encoders_quality.md and others, from rows of `encoders.py`."""

from __future__ import annotations

import statistics
from collections import Counter
from collections.abc import Iterator, Sequence

import numpy as np
from rows import Row
from scipy.stats import wilcoxon

LOSSES = ("mse", "loi", "perceptual", "lpips")
TRACED = ("san_miguel", "beads")  # noisy: what was seen is the luckiest too, what counts is judged
STEP = 50  # renders between two points of a curve


def tables(rows: list[Row]) -> str:
    """All tables, in Markdown: medians over the seeds that all configurations of a table share."""
    traced = [row for row in rows if row["task"] in TRACED]
    rows = [row for row in rows if row["task"] not in TRACED]
    every = of(rows, "encoder")
    handmade = [row for row in every if row["configuration"][8:] in ("dense", "patch")]
    with_networks = {(row["task"], row["size"]) for row in every if row not in handmade}
    networks = [row for row in every if (row["task"], row["size"]) in with_networks]
    blocks = [
        encoder_table(handmade, (500, 1000, 2000)),
        encoder_table(up_to_the_shortest(networks), (100, 200, 300, 500, 1000)),
        loss_table(of_losses(rows)),
        traced_table(traced, (200, 400, 600)),
        versions([*rows, *traced]),
    ]
    return "\n\n".join("\n".join(block) for block in blocks)


def versions(rows: list[Row]) -> list[str]:
    """Which versions of encoders made the features of the rows, and of how many: one line."""
    counts = Counter(row["encoder"] for row in rows)
    return [f"Runs: {', '.join(f'{n} with {version}' for version, n in sorted(counts.items()))}."]


def of(rows: list[Row], kind: str) -> list[Row]:
    return [row for row in rows if row["configuration"].startswith(f"{kind} ")]


def up_to_the_shortest(rows: list[Row]) -> list[Row]:
    """Rows with curves of the same length: no run knows its budget, so all are alike till then."""
    length = min((len(row["best"]) for row in rows), default=0)
    return [{**row, "best": row["best"][:length]} for row in rows]


def of_losses(rows: list[Row]) -> list[Row]:
    """Rows that differ in the loss; the encoder `dense` has minimized the mean squared error."""
    others = of(rows, "loss")
    where = {(row["task"], row["size"]) for row in others}
    mse = [row for row in rows if row["configuration"] == "encoder dense"]
    return [
        {**r, "configuration": "loss mse"} for r in mse if (r["task"], r["size"]) in where
    ] + others


def traced_table(rows: list[Row], marks: Sequence[int]) -> list[str]:
    """Lowest loss seen after some renders, and every loss of what was found, on the reference."""
    names = [name for name in LOSSES if any(name in row["judged"] for row in rows)]
    lines = [
        f"| task | minimized | encoder | runs | {' | '.join(f'{m:,}' for m in marks)} | "
        f"{' | '.join(f'judged {name}' for name in names)} |",
        "|---|---|---|" + "---:|" * (1 + len(marks) + len(names)),
    ]
    for task, label, group in groups(rows):
        kind, configuration = label.split(" ", 1)
        minimized, encoder = (
            ("mse", configuration) if kind == "encoder" else (configuration, "dense")
        )
        seen = [median_at(group, mark) for mark in marks]
        judged = [f"{statistics.median(row['judged'][n] for row in group):.4g}" for n in names]
        cells = [task, minimized, encoder, str(len(group)), *seen, *judged]
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def groups(rows: list[Row]) -> Iterator[tuple[str, str, list[Row]]]:
    """Task, configuration and rows, of the seeds that all configurations of the task have."""
    for task, size in dict.fromkeys((row["task"], row["size"]) for row in rows):
        mine = [row for row in rows if (row["task"], row["size"]) == (task, size)]
        by_configuration: dict[str, dict[int, Row]] = {}
        for row in mine:
            by_configuration.setdefault(row["configuration"], {})[row["seed"]] = row
        shared = set.intersection(*(set(by_seed) for by_seed in by_configuration.values()))
        for configuration, by_seed in by_configuration.items():
            if len(by_configuration) > 1 and shared:
                yield (
                    f"{task}, {size} px",
                    configuration,
                    [by_seed[seed] for seed in sorted(shared)],
                )


def encoder_table(rows: list[Row], marks: Sequence[int]) -> list[str]:
    """Losses after some renders, milliseconds a render, and the comparison with `patch`."""
    marks = [m for m in marks if any(len(row["best"]) * STEP >= m for row in rows)]
    head = ["task", "encoder", "runs", *(f"{m:,}" for m in marks), "better than `patch`", "ms"]
    lines = [f"| {' | '.join([*head, 'time to the loss of `patch`'])} |"]
    lines.append("|---|---|" + "---:|" * (len(head) - 1))
    table = list(groups(rows))
    patch = {task: group for task, configuration, group in table if configuration[8:] == "patch"}
    for task, configuration, group in table:
        losses_then = [median_at(group, renders) for renders in marks]
        cost = f"{statistics.median(row['ms'] for row in group):.2f}"
        compared = compared_to(group, patch[task]) if task in patch else ("", "")
        better = "" if configuration[8:] == "patch" else compared[0]
        cells = [task, configuration[8:], len(group), *losses_then, better, cost, compared[1]]
        lines.append(f"| {' | '.join(map(str, cells))} |")
    return lines


def compared_to(rows: list[Row], others: list[Row]) -> tuple[str, str]:
    """In how many runs the end is better than the other's, and the median share of its time."""
    wins = sum(r["best"][-1] < o["best"][-1] for r, o in zip(rows, others, strict=True))
    share = statistics.median(map(share_of_time, rows, others))
    return f"{wins} of {len(rows)}", f"{share:.2f}" if share < float("inf") else "not reached"


def median_at(rows: list[Row], renders: int) -> str:
    """Median best loss after so many renders."""
    if any(len(row["best"]) * STEP < renders for row in rows):
        return ""
    return f"{statistics.median(row['best'][renders // STEP - 1] for row in rows):.5f}"


def share_of_time(row: Row, other: Row) -> float:
    """The time a run took to the other's final loss, over the time the other took; inf if never."""
    final = other["best"][-1]
    mine, others = (time_to(final, each) for each in (row, other))
    return mine / others


def time_to(loss: float, row: Row) -> float:
    """Milliseconds of the optimizer until a run had that loss; inf if it never had."""
    reached = [i for i, value in enumerate(row["best"], 1) if value <= loss]
    return float(reached[0] * STEP * row["ms"]) if reached else float("inf")


def paired_table(rows: list[Row], one: str = "dense", other: str = "patch") -> list[str]:
    """Loss of one encoder over another's on the same targets: geometric mean, how often, chance.

    The interval is of two standard errors of the mean logarithm; p is that of Wilcoxon's
    signed-rank test, two-sided, that the logarithms differ in neither direction.
    """
    handmade = [row for row in of(rows, "encoder") if row["configuration"][8:] in (one, other)]
    groups_of = {
        (task, configuration[8:]): group for task, configuration, group in groups(handmade)
    }
    head = f"| task | renders | pairs | `{one}` / `{other}` | better | p |"
    lines = [head, "|---|" + "---:|" * 5]
    for task in dict.fromkeys(task for task, _ in groups_of):
        pairs = list(zip(groups_of[task, one], groups_of[task, other], strict=True))
        for mark in (500, 1000, 2000):
            short = any(len(row["best"]) * STEP < mark for pair in pairs for row in pair)
            if len(pairs) < 2 or short:
                continue
            at = mark // STEP - 1
            d = np.array([np.log(own["best"][at] / its["best"][at]) for own, its in pairs])
            middle, error = d.mean(), 2 * d.std(ddof=1) / np.sqrt(len(d))
            low, ratio, high = np.exp([middle - error, middle, middle + error])
            lines.append(
                f"| {task} | {mark:,} | {len(d)} | {ratio:.2f} ({low:.2f} to {high:.2f}) | "
                f"{(d < 0).sum()} of {len(d)} | {wilcoxon(d).pvalue:.2g} |"
            )
    return [*lines, "", *versions(handmade)]


def loss_table(rows: list[Row]) -> list[str]:
    names = [name for name in LOSSES if any(name in row["judged"] for row in rows)]
    lines = [f"| task | minimized | runs | {' | '.join(names)} | ms |"]
    lines.append("|---|---|" + "---:|" * (len(names) + 2))
    for task, configuration, group in groups(rows):
        judged = [
            f"{statistics.median(row['judged'][name] for row in group):.4g}" for name in names
        ]
        cost = statistics.median(row["ms"] for row in group)
        lines.append(
            f"| {task} | {configuration[5:]} | {len(group)} | {' | '.join(judged)} | {cost:.2f} |"
        )
    return lines
