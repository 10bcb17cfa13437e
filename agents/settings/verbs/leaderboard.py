"""Settings of `maexp leaderboard`."""

from dataclasses import dataclass
from typing import Any

from maexp.envs.config_fields import setting


@dataclass
class LeaderboardSettings:
    """`maexp leaderboard`."""

    places: Any = setting(None, "folders of maexp suite run, rows, or folders of rows; written without places=")
    out: str | None = setting(None, "folder of rows and the page; rows that are there stay")
    verify: bool = setting(True, "play the actions of each run again, and refuse those that are not what they say")
    note: str | None = setting(None, "a sentence for these rows: how the policy was made, with which weights")
    suite: str | None = setting(None, "the .yaml file of a suite that does not come with the package")
