"""The campaign's result, kind by kind, as a table."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any


@dataclass
class Row:
    """One kind of fault, summed over its rounds.

    Attributes:
        injected: how many there were.
        survived: how many of them were in rounds that kept every promise.
        runs: how often the job was submitted.
        processor_s: processor time beyond that of undisturbed runs [s].
        made_again: outputs committed beyond one of each.
        broken: sentences about promises that were not kept.
    """

    injected: int = 0
    survived: int = 0
    runs: int = 0
    processor_s: float = 0.0
    made_again: int = 0
    broken: list[str] = field(default_factory=list)


@dataclass
class Result:
    """A whole campaign."""

    seed: int
    scene: str
    undisturbed_s: float
    outputs: int
    rows: dict[str, Row] = field(default_factory=lambda: defaultdict(Row))
    moments: dict[str, int] = field(default_factory=lambda: defaultdict(int))

    @property
    def broken(self) -> list[str]:
        """Every promise that was not kept."""
        return [f"{kind}: {sentence}" for kind, row in self.rows.items() for sentence in row.broken]

    def to_json(self) -> dict[str, Any]:
        """Plain values, for `--json`."""
        return {
            "seed": self.seed,
            "scene": self.scene,
            "undisturbed_s": self.undisturbed_s,
            "outputs": self.outputs,
            "rows": {kind: asdict(row) for kind, row in self.rows.items()},
            "moments": dict(self.moments),
            "broken": self.broken,
        }

    def markdown(self) -> str:
        """Tables for docs/guide/reliability.md."""
        lines = [
            f"Seed {self.seed}, scene `{self.scene}`: {self.outputs} outputs, {self.undisturbed_s:.1f} s of processor "
            "time undisturbed.",
            "",
            "| fault | injected | survived | outputs made again [%] | processor time redone [%] |",
            "|---|---|---|---|---|",
        ]
        total = Row()
        for kind, row in self.rows.items():
            lines.append(self._line(kind, row))
            total.injected += row.injected
            total.survived += row.survived
            total.made_again += row.made_again
            total.processor_s += row.processor_s
        lines += [self._line("**all**", total), "", _moments_line(self.moments)]
        return "\n".join(lines)

    def _line(self, kind: str, row: Row) -> str:
        injected = max(1, row.injected)
        again = 100.0 * row.made_again / self.outputs / injected
        time = 100.0 * row.processor_s / self.undisturbed_s / injected
        return f"| {kind} | {row.injected} | {row.survived} | {again:.1f} | {time:.0f} |"


def _moments_line(moments: dict[str, int]) -> str:
    told: Sequence[str] = [f"{name} ({count})" for name, count in sorted(moments.items())]
    return f"Moments: {'; '.join(told)}."
