"""Networks, the six algorithms, training and evaluation.

Names are looked up on first use, so that `maexp maps ...` need not wait for TorchRL.
"""

from maexp.kernels.lazy import lazy_names
from maexp.kernels.moved import redirect_modules

_HOMES = {
    "load_policy": "training.make",
    "make_env": "cli.env",
    "make_policy": "training.make",
    "make_critic": "algorithms.registry",
    "make_loss": "algorithms.registry",
    "ALGORITHMS": "algorithms.registry",
    "ModelConfig": "config.model",
}
__all__ = ["ALGORITHMS", "ModelConfig", "load_policy", "make_critic", "make_env", "make_loss", "make_policy"]

__getattr__ = lazy_names(__name__, _HOMES)

redirect_modules(
    __name__,
    {
        "benchmark": "benchmarks",
        "conditions": "benchmarks.conditions",
        "evaluation.films": "evaluation.video",
        "irsim": "deploy.irsim",
        "measures": "evaluation.metric_format",
        "networks": "models",
        "policies.connection": "policies.remote.server",
        "policies.wire": "policies.remote.protocol",
        "policies.foreign": "policies.remote.numpy_policy",
        "policies.load": "policies.pretrained",
        "ros2": "deploy.ros2",
        "runtime.agent": "deploy.planner.arena_policy",
        "runtime.base_driver": "deploy.planner.drivers",
        "runtime.choices": "deploy.planner.scene",
        "runtime.contacts": "deploy.planner.radio_features",
        "runtime.driver": "deploy.planner.team_driver",
        "runtime.folder": "deploy.planner.bundle",
        "runtime.frames": "deploy.planner.frames",
        "runtime.grid": "deploy.planner.grid",
        "runtime.planner": "deploy.planner.team_planner",
        "runtime.radio_driver": "deploy.planner.drivers",
        "runtime.robot": "deploy.planner.robot_planner",
        "runtime.robot_driver": "deploy.planner.drivers",
        "runtime.shipped": "deploy.planner.bundle",
        "runtime.team": "deploy.planner.team",
        "runtime.ways": "deploy.planner.grid_search",
        "runtime.words": "deploy.planner.messages",
        "settings": "config",
        "speed": "benchmarks.throughput",
        "suites": "benchmarks.suites",
    },
)
