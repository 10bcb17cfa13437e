"""Settings of `maexp suite`."""

from dataclasses import dataclass

from omegaconf import MISSING

from maexp.agents.settings.groups import LAST_SEED
from maexp.envs.config_fields import setting


@dataclass
class SuiteSettings:
    """`maexp suite`."""

    task: str = MISSING
    place: str | None = setting(None, "the suite, or the .yaml file of one; verify: the folder of a run")
    policy: str | None = setting(None, "run: a name, run or folder, module:Class, exec:COMMAND, socket:HOST:PORT")
    name: str | None = setting(None, "run: what results call the policy; default: its own name")
    suite: str | None = setting(None, "verify: the .yaml file of a suite that does not come with the package")
    seed: int | None = setting(
        None, "run: plays other maps and starts than the frozen ones, those of this seed", low=0, high=LAST_SEED
    )
    resume: str | None = setting(None, "run: folder of a run to go on with")
    num_envs: int = setting(16, "run: teams at once", low=1)
    workers: int | None = setting(
        None, "run: teams at once in processes; default: as many as cores, by socket one", low=1
    )
    decision_limit: float | None = setting(
        None, "run: its processor time a decision; default: the suite's", unit="s", above=0
    )
    patience: float = setting(120.0, "run: how long it may be silent", unit="s", above=0)
    device: str = setting("cpu", "run: cpu, cuda, ...; bits are promised on one platform alone")
