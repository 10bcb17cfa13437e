"""What the groups of an env's settings share: they fill in what is None from the scenario, and check themselves."""

from dataclasses import dataclass, fields, replace
from typing import ClassVar, Self

from maexp.envs.config_fields import check_settings
from maexp.envs.scenarios import Scenario, find_scenario


@dataclass(frozen=True)
class Group:
    """Settings that go together, called ``group`` on the command line."""

    group: ClassVar[str]

    def completed(self, scenario: Scenario) -> Self:
        """With what is None taken from the scenario where that says it, and every value checked.

        Raises:
            ValueError: a value is out of its range (named).
        """
        names = {
            field.name: field.metadata.get("scenario") for field in fields(self) if getattr(self, field.name) is None
        }
        return replace(self, **{setting: getattr(scenario, name) for setting, name in names.items() if name}).checked()

    def checked(self) -> Self:
        """Itself, if every value is in its range and the values go together; else ValueError."""
        check_settings(self, self.group)
        return self


def supplied(kind: type[Group]) -> list[str]:
    """Settings of a robot, radar or planner that are None by default and that a scenario, any one, fills in."""
    filled = kind().completed(find_scenario("maze"))
    return [field.name for field in fields(kind) if field.default is None and getattr(filled, field.name) is not None]
