"""What an import did, step by step, with counts."""

from dataclasses import dataclass, field


@dataclass(frozen=True)
class ImportStep:
    """One step: what it did, and how much there was before and after (cells, points; None: does not apply)."""

    name: str
    detail: str
    before: int | None = None
    after: int | None = None


@dataclass
class ImportReport:
    """The steps of one import in order, and warnings a person should read."""

    path: str
    steps: list[ImportStep] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    seconds: float = 0.0

    def add(self, name: str, detail: str, before: int | None = None, after: int | None = None) -> None:
        self.steps.append(ImportStep(name, detail, before, after))

    def warn(self, text: str) -> None:
        self.warnings.append(text)

    def table(self) -> str:
        """The report as text: one line a step."""
        head = ("step", "before", "after", "what was done")
        rows = [(step.name, _count(step.before), _count(step.after), step.detail) for step in self.steps]
        widths = [max(len(row[column]) for row in [head, *rows]) for column in range(3)]
        lines = [
            f"{row[0]:<{widths[0]}}  {row[1]:>{widths[1]}}  {row[2]:>{widths[2]}}  {row[3]}" for row in [head, *rows]
        ]
        lines.insert(0, f"import of {self.path} ({self.seconds:.1f} s)")
        lines += [f"warning: {text}" for text in self.warnings]
        return "\n".join(lines)


def _count(value: int | None) -> str:
    return "" if value is None else f"{value:,}"
