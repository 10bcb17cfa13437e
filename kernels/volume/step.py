"""The order of the stages in volumes: of a local step, a decision and a reset; nothing else."""

from maexp.kernels.faults import fail_robots
from maexp.kernels.launches import Launch
from maexp.kernels.radio import note_links, place_base
from maexp.kernels.reset import start_episodes
from maexp.kernels.reward import close_step, reward_robots
from maexp.kernels.shards import Shard
from maexp.kernels.volume.coarse import find_cells, flood, place_targets
from maexp.kernels.volume.gain import look_around
from maexp.kernels.volume.mapping import forget_maps, merge_scans, share_maps
from maexp.kernels.volume.motion import find_ways, move_robots
from maexp.kernels.volume.reset import place_teams
from maexp.kernels.volume.scan import scan


def local_step(launch: Launch, shard: Shard) -> None:
    """Fail, move, collide, scan, merge, share, reward, terminate, in the envs that are active."""
    active = shard.view.active
    fail_robots(launch, shard, active)
    move_robots(launch, shard)
    scan(launch, shard, active, ahead=1)
    merge_scans(launch, shard, active, ahead=1)
    share_maps(launch, shard, active)
    note_links(launch, shard)
    reward_robots(launch, shard)
    close_step(launch, shard)


def look(launch: Launch, shard: Shard) -> None:
    """Bring room, cells, distances and targets of the envs of ``looked`` up to date."""
    find_cells(launch, shard)
    flood(launch, shard)
    place_targets(launch, shard)
    look_around(launch, shard)


def reset(launch: Launch, shard: Shard) -> None:
    """Start the envs of ``mask`` anew: place their teams and take the first scan."""
    mask = shard.view.mask
    place_teams(launch, shard)
    place_base(launch, shard)
    forget_maps(launch, shard)
    fail_robots(launch, shard, mask)
    scan(launch, shard, mask, ahead=0)
    merge_scans(launch, shard, mask, ahead=0)
    share_maps(launch, shard, mask)
    start_episodes(launch, shard)


STAGES = (local_step, look, reset, find_ways)
