"""Memory: what a run will need, estimated before it starts, and how freed memory is kept."""

import ctypes
import os

from maexp.agents.errors import UserError

COPIES = 3  # the collector's list of steps, the stacked batch, and the updater's selection


def check_batch_memory(env, steps: int, num_envs: int | None = None) -> None:
    """Refuse batches that cannot fit, of `num_envs` teams like those of `env` (default: as many as it has).

    Raises:
        UserError: names the settings to lower.
    """
    num_envs = num_envs or env.num_envs
    specs = [env.observation_spec, env.full_action_spec]
    one_step = sum(leaf.zero().nbytes for spec in specs for leaf in spec.values(True, True)) / env.num_envs
    simulation = env.space.bytes_per_env(env.settings, env.bank) * num_envs
    need = simulation + COPIES * 2 * one_step * num_envs * steps  # each step is stored as it was and as it became
    if env.device.type == "cuda":
        import torch

        have = torch.cuda.get_device_properties(env.device).total_memory
    else:
        have = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    if need > have:
        raise UserError(
            f"One batch of num_envs={num_envs} x collector.steps={steps} needs about {need / 2**30:.1f} GiB "
            f"({simulation / 2**30:.1f} GiB of it for the simulation), more than the {have / 2**30:.1f} GiB of "
            f"{env.device}: lower num_envs or collector.steps."
        )


def keep_freed_memory() -> None:
    """Let glibc reuse freed blocks of tensors instead of returning them to the system.

    Batches of pictures are larger than the size from which glibc asks the system for new pages, which it must
    then clear one by one: measured, a third of the small policy's forward pass. Other C libraries ignore this.
    """
    try:
        mallopt = ctypes.CDLL("libc.so.6").mallopt
    except (OSError, AttributeError):
        return
    m_mmap_max, m_trim_threshold = -4, -1
    mallopt(m_mmap_max, 0)
    mallopt(m_trim_threshold, 2**31 - 1)
