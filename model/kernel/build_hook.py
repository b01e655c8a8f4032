"""Hatchling's hook: compile the kernel before a wheel or an editable installation is made."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface
from packaging.tags import sys_tags


def _beside(name: str) -> ModuleType:
    """A file of this folder: the package that it belongs to is not installed yet."""
    spec = importlib.util.spec_from_file_location(f"dea_kernel_{name}", Path(__file__).with_name(f"{name}.py"))
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[module.__name__] = module
    spec.loader.exec_module(module)
    return module


class KernelHook(BuildHookInterface[Any]):
    """The wheel has the library and a platform where one could be compiled, and is pure Python otherwise."""

    def dependencies(self) -> list[str]:
        return list(_beside("build").requirements()) if self.target_name == "wheel" else []

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        if self.target_name != "wheel":
            return
        build, library = _beside("build"), _beside("library")
        directory = Path(self.root, "model", "kernel")
        try:
            path, compiler = build.compile_kernel(directory, library)
        except build.Failed as failed:
            self.app.display_warning(f"The membrane solver stays in NumPy, without its compiled kernel: {failed}")
            path = library.reason_path(directory)
        else:
            self.app.display_info(f"The membrane solver's kernel was compiled with {compiler}: {path.name}")
            # Not manylinux: nobody has checked which systems the library fits beside this one.
            platforms = (tag.platform for tag in sys_tags())
            platform = next(name for name in platforms if not name.startswith(("manylinux", "musllinux")))
            build_data["pure_python"] = False
            build_data["tag"] = f"py3-none-{platform}"
        if version == "standard" and path.exists():  # an editable installation has the folder itself
            build_data["force_include"][str(path)] = f"model/kernel/{path.name}"
