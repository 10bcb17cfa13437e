"""The constrained policy step of TRPO (Schulman et al. 2015) as a torch optimizer.

step: g . d is improved subject to 1/2 d . F d <= max_kl, where F, the Fisher matrix, is the second derivative
of the divergence from the acting policy. Conjugate gradient gives the direction, a line search the length.
"""

from collections.abc import Callable, Iterable

import torch
from torch import Tensor
from torch.nn.attention import SDPBackend, sdpa_kernel

Closure = Callable[[], tuple[Tensor, Tensor]]


def flatten(tensors: Iterable[Tensor | None], like: list[Tensor]) -> Tensor:
    """One vector of all entries; None counts as zeros of the parameter's shape."""
    pairs = zip(tensors, like, strict=True)
    return torch.cat([torch.zeros_like(p).flatten() if t is None else t.flatten() for t, p in pairs])


def conjugate_gradient(product: Callable[[Tensor], Tensor], b: Tensor, steps: int, tolerance=1e-10) -> Tensor:
    """Solve A x = b for a positive definite A given by its products with vectors.

    Args:
        product: v -> A v
        b: right-hand side, shape [n]
        steps: at most so many products
        tolerance: stop when the squared residual falls below this share of the first
    """
    x = torch.zeros_like(b)
    residual = b.clone()
    direction = b.clone()
    size = first = residual @ residual
    for _ in range(steps):
        if size <= tolerance * first:
            break
        image = product(direction)
        length = size / (direction @ image)
        x += length * direction
        residual -= length * image
        size, previous = residual @ residual, size
        direction = residual + (size / previous) * direction
    return x


class TRPO(torch.optim.Optimizer):
    """Trust-region steps for the parameters of a policy.

    Args:
        params: the policy's parameters (one group)
        max_kl: bound on the mean divergence of an accepted step
        accept_ratio: a step must improve the loss by at least this share of what the gradient promises
        damping: added to the Fisher matrix's diagonal
        cg_steps: conjugate-gradient steps
        backtracks: lengths tried
        backtrack_factor: each length over the one before
    """

    def __init__(
        self,
        params,
        max_kl: float = 0.06,
        accept_ratio: float = 0.5,
        damping: float = 0.1,
        cg_steps: int = 10,
        backtracks: int = 15,
        backtrack_factor: float = 0.8,
    ):
        if max_kl <= 0:
            raise ValueError(f"max_kl={max_kl} must be positive.")
        settings = dict(
            max_kl=max_kl,
            accept_ratio=accept_ratio,
            damping=damping,
            cg_steps=cg_steps,
            backtracks=backtracks,
            backtrack_factor=backtrack_factor,
        )
        super().__init__(params, settings)
        if len(self.param_groups) != 1:
            raise ValueError("TRPO takes one group of parameters: the trust region binds them together.")

    def step(self, closure: Closure, fisher_closure: Callable[[], Tensor] | None = None) -> dict[str, float]:
        """Take one step, or none if no length on the line passes; then the parameters stay bit for bit.

        Args:
            closure: () -> (loss to lower, mean divergence from the acting policy), scalars with their graphs;
                called once with gradients and once per length tried without
            fisher_closure: () -> mean divergence over fewer states, for the Fisher matrix alone; each of its
                products costs a second derivative. None takes the divergence of `closure`

        Returns:
            kl, improvement, expected (of the accepted step), accepted (0 or 1), step_length
        """
        group = self.param_groups[0]
        params = [p for p in group["params"] if p.requires_grad]
        with torch.enable_grad():
            with sdpa_kernel(SDPBackend.MATH):  # the fast attention kernels have no second derivative
                loss, divergence = closure()
                divergence = divergence if fisher_closure is None else fisher_closure()
            gradient = torch.autograd.grad(loss, params, retain_graph=fisher_closure is None, allow_unused=True)
            gradient = flatten(gradient, params)
            product = self._fisher_product(divergence, params)
            direction = conjugate_gradient(product, -gradient, group["cg_steps"])
            curvature = direction @ product(direction)
        full = direction * (2 * group["max_kl"] / curvature.clamp_min(1e-12)).sqrt()
        return self._search(closure, params, full.detach(), loss.detach(), gradient)

    def _fisher_product(self, divergence: Tensor, params: list[Tensor]) -> Callable[[Tensor], Tensor]:
        """v -> (F + damping) v from one graph of the divergence's gradient, kept for all products."""
        damping = self.param_groups[0]["damping"]
        slope = torch.autograd.grad(divergence, params, create_graph=True, allow_unused=True)
        slope = flatten(slope, params)

        def product(vector: Tensor) -> Tensor:
            image = torch.autograd.grad(slope @ vector, params, retain_graph=True, allow_unused=True)
            return flatten(image, params) + damping * vector

        return product

    @torch.no_grad()
    def _search(self, closure: Closure, params: list[Tensor], full: Tensor, loss: Tensor, gradient: Tensor) -> dict:
        """Try ever shorter steps along `full`; keep the first that improves enough within the region."""
        group = self.param_groups[0]
        before = [p.clone() for p in params]
        promised = -(gradient @ full)
        share = 1.0
        for _ in range(group["backtracks"] if torch.isfinite(full).all() else 0):
            self._place(params, before, full, share)
            new_loss, divergence = closure()
            gain, expected = loss - new_loss, promised * share
            if divergence <= group["max_kl"] and gain > 0 and gain >= group["accept_ratio"] * expected:
                return _report(divergence, gain, expected, 1.0, share * full.norm())
            share *= group["backtrack_factor"]
        for p, old in zip(params, before, strict=True):
            p.copy_(old)
        zero = torch.zeros((), dtype=torch.float32)
        return _report(zero, zero, promised, 0.0, zero)

    @staticmethod
    def _place(params: list[Tensor], before: list[Tensor], full: Tensor, share: float) -> None:
        start = 0
        for p, old in zip(params, before, strict=True):
            p.copy_(old + share * full[start : start + p.numel()].view_as(p))
            start += p.numel()


def _report(divergence: Tensor, gain: Tensor, expected: Tensor, accepted: float, length: Tensor) -> dict:
    return {
        "kl": divergence.item(),
        "improvement": gain.item(),
        "expected": expected.item(),
        "accepted": accepted,
        "step_length": length.item(),
    }
