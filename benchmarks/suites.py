"""All suites together, or some of them, scene by scene: FIDE, or `--ours`, against one rival.

    python benchmarks/suites.py dfols              # 500 renders
    python benchmarks/suites.py eki --budget 2000
    python benchmarks/suites.py dfols --suites image-fitting-v3
    python benchmarks/suites.py eki --ours eki:popsize=200 --budget 10000

Each line is a scene, with the problems of these suites that both have finished up to the budget:
how many each has solved, how many only one of the two, and on how many of those that at most one
has solved the first one's loss is lower.  p of the exact McNemar and sign tests, not adjusted.
The runs are those that suite.py has measured.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence

import numpy as np
from rows import Row, rows_of
from suite import budget_of, file_of, label_of, longest

from fide_lab.report.tables import Table, markdown
from fide_lab.suite import names, read
from fide_lab.suite.page import sign_test
from fide_lab.suite.scores import within

Pair = tuple[str, float, float, float, float]
"""Scene; renders until the two have solved the problem, +inf if not; their losses."""


def pairs(ours_is: str, rival: str, budget: int, of: Sequence[str]) -> Iterator[Pair]:
    """Of all problems of these suites that both have finished."""
    both = (ours_is, rival)
    for name in of:
        suite = read(name)
        found = longest(rows_of(file_of(suite)), both, budget_of(suite, budget))
        for problem in dict.fromkeys(problem for problem, _ in found):
            ours, theirs = (found.get((problem, label)) for label in both)
            if ours and theirs:
                yield pair_of(suite.parts(problem)[0], ours, theirs, budget)


def pair_of(name: str, ours: Row, theirs: Row, budget: int) -> Pair:
    """Two runs of one problem, within so many renders."""
    t = np.array([row["solved_at"] or np.inf for row in (ours, theirs)])
    a, b = within(t, budget).tolist()
    return name, a, b, ours["losses"][str(budget)], theirs["losses"][str(budget)]


def line(name: str, found: list[Pair]) -> tuple[str, ...]:
    """A line of the table."""
    ours, theirs = (np.isfinite([pair[i] for pair in found]) for i in (1, 2))
    a, b = np.array([pair[3:] for pair in found if np.isinf(max(pair[1:3]))]).reshape(-1, 2).T
    only = int((ours & ~theirs).sum()), int((theirs & ~ours).sum())
    mcnemar = sign_test(ours.astype(float), theirs.astype(float))
    return (
        name, str(len(found)), str(ours.sum()), str(theirs.sum()), f"{only[0]}, {only[1]}",
        f"{mcnemar:.2g}", f"{(a < b).sum()} of {len(a)}", f"{sign_test(a, b):.2g}",
    )  # fmt: skip


def table(lines: Sequence[tuple[str, ...]], ours: str, theirs: str) -> str:
    """The lines under their titles, in Markdown; names of the two that they compare."""
    titles = (
        "scene", "problems", ours, theirs, f"only {ours}, only {theirs}", "p",
        f"{ours} lower", "p of losses",
    )  # fmt: skip
    return markdown(Table("", tuple((title, "") for title in titles), tuple(lines)))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("rival", help="as in the rows, such as dfols or eki:popsize=200")
    parser.add_argument("--budget", type=int, default=500, metavar="N", help="of the suites")
    parser.add_argument("--suites", nargs="+", choices=names(), default=names(), metavar="NAME")
    parser.add_argument("--ours", default="fide", metavar="NAME", help="instead of FIDE's default")
    arguments = parser.parse_args()
    ours, rival = label_of(arguments.ours), label_of(arguments.rival)
    found = list(pairs(ours, rival, arguments.budget, arguments.suites))
    if not found:
        parser.error(f"no problem is finished by {ours} and {rival}")
    scenes = dict.fromkeys(pair[0] for pair in found)
    lines = [line(scene, [pair for pair in found if pair[0] == scene]) for scene in scenes]
    print(table([*lines, line("all", found)], ours, rival))


if __name__ == "__main__":
    main()
