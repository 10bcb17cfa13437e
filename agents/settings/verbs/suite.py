"""Settings of `maexp suite`."""

from dataclasses import dataclass

from omegaconf import MISSING

from maexp.envs.fields import setting


@dataclass
class SuiteSettings:
    """`maexp suite`."""

    task: str = MISSING
    place: str | None = setting(None, "the suite, or the .yaml file of one; verify: the folder of a run")
    policy: str | None = setting(None, "run: a name, run or folder, module:Class, exec:COMMAND, socket:HOST:PORT")
    name: str | None = setting(None, "run: what results call the policy; default: its own name")
    suite: str | None = setting(None, "verify: the .yaml file of a suite that does not come with the package")
    seed: int | None = setting(None, "run: plays other maps and starts than the frozen ones, those of this seed")
    resume: str | None = setting(None, "run: folder of a run to go on with")
    num_envs: int = setting(16, "run: teams at once")
    workers: int | None = setting(None, "run: teams at once in processes; default: as many as cores, by socket one")
    decision_limit: float | None = setting(None, "run: its processor time a decision [s]; default: the suite's")
    patience: float = setting(120.0, "run: how long it may be silent [s]")
    device: str = setting("cpu", "run: cpu, cuda, ...; bits are promised on one platform alone")
