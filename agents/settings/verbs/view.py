"""Settings of `maexp view`."""

from dataclasses import dataclass

from omegaconf import MISSING

from maexp.agents.settings.groups import MOST_TEAMS, LearnerSettings
from maexp.envs.config_fields import setting


@dataclass
class ViewSettings(LearnerSettings):
    """`maexp view`."""

    action: str = MISSING  # which file of conf/action
    place: str | None = setting(None, "a run, a checkpoint, a folder of maexp evaluate, an episode or a map")
    index: int | None = setting(
        None, "which map of the scenario; default: the first, for a team the first held out", low=0
    )
    policy: str | None = setting(None, "a policy to watch, as of maexp evaluate, on the map given or a held-out one")
    checkpoint: str | None = None  # what `place` becomes where it is a run
    num_robots: int = setting(3, "robots in a team", low=1)
    num_envs: int = setting(1, "teams to watch, each in a held-out episode of its own", low=1, high=MOST_TEAMS)
    episode: int | None = setting(None, "number of the first held-out episode to watch; default: the first there is")
    seconds: float | None = setting(None, "moment of the picture; default: the end", unit="s", low=0)
    seen_by: int | None = setting(None, "count as explored only what this robot has seen, from 0")
    browser: bool = setting(False, "replay on a page in the browser, with the extra maexp[view]")
    port: int = setting(8080, "of the page; another one where it is taken", low=0, high=65535)
    out: str | None = setting(None, "file to write: .png, or .html for a page that needs no server")
    renderer: str = setting("auto", "of the picture: open3d, painter (ours), or auto: the first that works")
    size: int = setting(1200, "width of the picture", unit="px", low=64, high=8192)
    azimuth: float = setting(
        -60.0, "where the camera stands, counter-clockwise from x", unit="degrees", low=-360, high=360
    )
    elevation: float = setting(50.0, "of the camera over the ground", unit="degrees", low=1, high=89)
    cut: float | None = setting(
        None, "highest walls drawn; default: as scanned, with a team 6 % of the map's side", unit="m", above=0
    )
