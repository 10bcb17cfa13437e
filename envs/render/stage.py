"""What a three-dimensional picture of a map or of a moment of an episode shows, in metres; no renderer in it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from maexp.envs.maps.point_cloud import PointCloudMap
from maexp.envs.render.frames import TRAIL_STEPS, point_colours, robot_colour, smallest_robot, smooth_trail

WALL_SHARE = 0.03  # height of walls where the map keeps none, as a share of its longer side
GROUND = (226, 230, 236)  # of a map without a team
_HEIGHT_RAMP = ((68, 84, 120), (96, 130, 160), (150, 178, 178), (210, 205, 170))  # low to high; rising lightness


@dataclass(frozen=True, eq=False)
class DrawnScene:
    """Coloured boxes and lines; colours are uint8 (..., 3), positions and sizes in metres, z up.

    Attributes:
        ground: free points, [F, 3], drawn as flat squares of side ground_size [F].
        walls: feet of the obstacles' columns, [O, 3], wall_size [O] wide and wall_height [O] high.
        robots: where the robots stand, [N, 3]; heading [N] [rad]; body: length, width, height, [N, 3].
        trails: where each robot drove lately, oldest first, [steps, N, 3].
        goals: [N, 3], NaN where a robot has none.
        radar_range: [N].
    """

    ground: np.ndarray
    ground_size: np.ndarray
    ground_colour: np.ndarray
    walls: np.ndarray
    wall_size: np.ndarray
    wall_height: np.ndarray
    wall_colour: np.ndarray
    robots: np.ndarray
    heading: np.ndarray
    body: np.ndarray
    robot_colour: np.ndarray
    collided: np.ndarray
    trails: np.ndarray
    goals: np.ndarray
    radar_range: np.ndarray

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lowest and highest corner of ground and walls, [3] each."""
        tops = self.walls + self.wall_height[:, None] * [0, 0, 1]
        every = np.concatenate([self.ground, self.walls, tops])
        return every.min(axis=0), every.max(axis=0)


class Stage:
    """A map prepared for scenes: its heights are worked out once, a scene of each moment costs little.

    Obstacles stand as columns: as high as the scan says where the map keeps heights, else 3 % of the map's longer
    side, but at most `cut` [m] above the ground. Heights count from the lowest free point.
    """

    def __init__(self, place: PointCloudMap, cut: float | None = None):
        self.map = place
        low, high = (np.array(corner) for corner in place.extent)
        self.side = float((high - low).max())
        self._tree = cKDTree(place.free[:, :2])
        lowest = 0.0 if place.free_height is None else float(place.free_height.min())
        heights = np.zeros(len(place.free)) if place.free_height is None else place.free_height - lowest
        self.ground = np.column_stack([place.free[:, :2], heights])
        feet = self.on_ground(place.obstacles[:, :2])
        tops = feet[:, 2] + WALL_SHARE * self.side
        if place.obstacle_height is not None:
            tops = place.obstacle_height - lowest
            feet[:, 2] = np.minimum(feet[:, 2], tops)
        if cut is not None:
            tops = np.minimum(tops, feet[:, 2] + cut)
        self.walls, self.wall_height = feet, np.maximum(tops - feet[:, 2], 0.02 * place.obstacle_spacing)
        self._boundary_of_wall = self._match_boundary()

    def _match_boundary(self) -> np.ndarray:
        """For each obstacle the boundary point at its place, or the number of these: it touches no free space."""
        if not len(self.map.boundary) or not len(self.map.obstacles):
            return np.full(len(self.map.obstacles), len(self.map.boundary))
        near = 1e-3 * self.map.resolution
        return cKDTree(self.map.boundary).query(self.map.obstacles, distance_upper_bound=near)[1]

    def on_ground(self, positions) -> np.ndarray:
        """Positions (..., 2) with the height of the nearest free point, (..., 3); NaN stays NaN."""
        positions = np.asarray(positions, dtype=np.float64)
        nearest = self._tree.query(np.nan_to_num(positions))[1]
        return np.concatenate([positions, self.ground[nearest][..., 2:]], axis=-1)

    def empty(self) -> DrawnScene:
        """The map alone; columns are coloured by their height where heights differ."""
        heights = self.walls[:, 2] + self.wall_height
        ramp, spread = np.array(_HEIGHT_RAMP, dtype=np.float64), float(np.ptp(heights)) if len(heights) else 0.0
        share = (heights - heights.min()) / spread if spread > 1e-6 else np.full(len(heights), 0.4)
        colours = np.stack([np.interp(share * (len(ramp) - 1), range(len(ramp)), axis) for axis in ramp.T], axis=-1)
        ground = np.tile(np.array(GROUND, dtype=np.uint8), (len(self.ground), 1))
        return self._scene(ground, np.rint(colours).astype(np.uint8), {})

    def inputs(self, snapshot: dict, robot: int | None = None) -> DrawnScene:
        """A moment of an episode; `robot`: only what this robot has seen counts as explored.

        Args:
            snapshot: what ``ExplorationEnv.snapshot(i)`` or ``Episode.snapshot(k)`` returns, on this map
        """
        if robot is not None:
            flags = ("seen_free", "seen_boundary", "visible")
            snapshot = snapshot | {name: snapshot[name][robot : robot + 1] for name in flags}
        table = point_colours(snapshot, len(self.map.free), len(self.map.boundary))
        ground, walls = table[1 : 1 + len(self.map.free)], table[1 + len(self.map.free) :]
        return self._scene(ground, walls[self._boundary_of_wall], self.moving(snapshot))

    def moving(self, snapshot: dict) -> dict:
        """The fields of a scene that change as robots drive, without the colours of points."""
        count = len(snapshot["pose"])
        length, width = np.asarray(snapshot["body"], dtype=np.float64).T
        grow = np.maximum(1.0, smallest_robot(count) * self.side / length)
        body = np.column_stack([length, np.maximum(width, 0.5 * length), 0.5 * length]) * grow[:, None]
        return {
            "robots": self.on_ground(snapshot["center"]),
            "heading": np.asarray(snapshot["pose"], dtype=np.float64)[:, 3],
            "body": body,
            "robot_colour": np.array([robot_colour(i) for i in range(count)], dtype=np.uint8).reshape(-1, 3),
            "collided": np.asarray(snapshot["collided"], dtype=bool),
            "trails": self.on_ground(smooth_trail(snapshot["trail"], snapshot["center"])[-TRAIL_STEPS - 1 :]),
            "goals": self.on_ground(snapshot["goal"]),
            "radar_range": np.asarray(snapshot["radar_range"], dtype=np.float64),
        }

    def _scene(self, ground_colour: np.ndarray, wall_colour: np.ndarray, moving: dict) -> DrawnScene:
        none = {
            "robots": np.zeros((0, 3)),
            "heading": np.zeros(0),
            "body": np.zeros((0, 3)),
            "collided": np.zeros(0, bool),
            "robot_colour": np.zeros((0, 3), np.uint8),
            "trails": np.zeros((0, 0, 3)),
            "goals": np.zeros((0, 3)),
            "radar_range": np.zeros(0),
        }
        return DrawnScene(
            ground=self.ground,
            ground_size=self.map.free_spacing,
            ground_colour=ground_colour,
            walls=self.walls,
            wall_size=self.map.obstacle_spacing,
            wall_height=self.wall_height,
            wall_colour=wall_colour,
            **(none | moving),
        )
