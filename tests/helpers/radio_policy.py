"""A small policy that looks at radios, and goes to tell the base station what that does not know."""

import pytest
import torch
from test_radio_features import HERE, PLACE, make

from maexp.agents import ModelConfig, make_policy
from maexp.agents.policies.export import export_policy, find_chooser
from maexp.envs.targets.features import feature_names

MUCH = 0.3  # of the feature `untold`


def make_told_policy():
    """Goes to tell once the base station lacks `MUCH`; else what an untrained one chooses, with some noise."""
    torch.manual_seed(5)
    made = make_policy(make(2, 1, PLACE, comm=HERE), ModelConfig(action="targets"))
    chooser, names = find_chooser(made), feature_names(True)
    with torch.no_grad():
        for weight in chooser.parameters():
            weight.copy_(0.01 * torch.randn(weight.shape) + (1.0 if weight is chooser.encoder.merge[0].weight else 0.0))
        first, last = chooser.encoder.inputs[0], chooser.encoder.inputs[2]
        first.weight[0, names.index("tells")], first.weight[0, names.index("untold")] = 10.0, 10.0
        first.bias[0] = -10.0 * (1.0 + MUCH)
        last.weight[0, 0] = chooser.encoder.merge[1].weight[0, 0] = chooser.head.weight[0, 0] = 1.0
    return made


def export_told(policy, where):
    """Its folder, for robots."""
    for name in ("onnx", "onnxscript", "onnxruntime", "safetensors"):
        pytest.importorskip(name, reason=f"THE EXTRA maexp[export] IS NOT INSTALLED ({name}): folders are not tested")
    export_policy(policy, make(2, 1, PLACE, comm=HERE), where, "told", "", {})
    return where
