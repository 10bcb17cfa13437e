"""Every Warp kernel of ours compiles for sm_80 and sm_90, with no GPU present."""

import importlib
import pkgutil

import pytest
import warp as wp

import maexp.kernels

pytestmark = pytest.mark.kernels


def kernel_modules() -> list[str]:
    """Names of our modules that define kernels."""
    found = []
    for info in pkgutil.walk_packages(maexp.kernels.__path__, "maexp.kernels."):
        module = importlib.import_module(info.name)
        if any(isinstance(v, wp.Kernel) and v.module.name == info.name for v in vars(module).values()):
            found.append(info.name)
    return found


def test_the_stages_of_the_step_are_found():
    stages = {"visibility", "merge", "dynamics", "collision", "planner", "reward", "observe", "reset"}
    assert stages <= {name.rsplit(".", 1)[1] for name in kernel_modules()}
    volumes = {"scan", "mapping", "coarse", "gain", "motion", "reset", "seeable"}
    assert {f"maexp.kernels.volume.{name}" for name in volumes} <= set(kernel_modules())


@pytest.mark.slow
@pytest.mark.parametrize("arch", [80, 90])
def test_compiles_for_cuda_without_a_gpu(arch, tmp_path):
    for name in kernel_modules():
        folder = tmp_path / name
        folder.mkdir()
        wp.compile_aot_module(name, arch=arch, module_dir=str(folder), use_ptx=True)
        built = [p for p in folder.rglob("*") if p.suffix in (".ptx", ".cubin")]
        assert built and all(f"sm_{arch}" in p.read_text(errors="ignore") for p in built if p.suffix == ".ptx"), name
