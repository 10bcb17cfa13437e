"""Weights of a policy: loaded only into the network they belong to."""

from torch import nn

from maexp.agents.errors import UserError


def load_matching(policy: nn.Module, state: dict) -> None:
    """Load a policy's weights.

    Raises:
        UserError: they belong to another network.
    """
    wrong = mismatched(policy.state_dict(), state)
    if wrong:
        raise UserError(
            f"The checkpoint holds another network ({len(wrong)} tensors differ, first {wrong[0]}): "
            "use the model and planner settings it was trained with."
        )
    policy.load_state_dict(state)


def mismatched(own: dict, state: dict) -> list[str]:
    """Names of the tensors that one of two states lacks, or that differ in shape."""
    wrong = [name for name in own if name not in state or state[name].shape != own[name].shape]
    return wrong + [name for name in state if name not in own]
