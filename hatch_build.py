"""Writes the commit into built packages, which have no repository to ask for it."""

import importlib.util
import tempfile
from pathlib import Path

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

PACKAGE = "src/optical_palpation"


class CommitHook(BuildHookInterface):
    """Adds ``commit.txt`` to wheels and source distributions."""

    def initialize(self, version, build_data):
        """Find the commit; a source distribution brings it along and an editable one asks later."""
        if version == "editable":
            return
        root = Path(self.root)
        spec = importlib.util.spec_from_file_location(
            "version", root / PACKAGE / "runtime" / "version.py"
        )
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        commit = module._of_repository(root)
        if not commit:
            return
        self._folder = tempfile.TemporaryDirectory()
        written = Path(self._folder.name) / module.COMMIT_FILE
        written.write_text(commit + "\n", encoding="ascii")
        inside = "optical_palpation" if self.target_name == "wheel" else PACKAGE
        build_data["force_include"][str(written)] = f"{inside}/{module.COMMIT_FILE}"

    def finalize(self, version, build_data, artifact_path):
        """Remove what was written for the build."""
        if hasattr(self, "_folder"):
            self._folder.cleanup()
