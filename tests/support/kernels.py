"""Compile every numba kernel that tests use, so that parallel workers find them in the cache."""

import subprocess
import sys

from tests.support.paths import ROOT

CODE = """
import tempfile
import socast
pipeline = socast.Pipeline(socast.load_model("extended_physical"), also=["cold_rolling"], keep_outlooks=True)
pipeline.push(list(socast.read_messages("recordings/shift.mcap")))
pipeline.finish()
pipeline.take_rides()
socast.make_tables("recordings/shift.mcap")
with tempfile.TemporaryDirectory() as folder:
    socast.simulate_fleet(f"{folder}/fleet.mcap", vehicles=1, shift_hours=0.5)
"""


def start_compiler() -> "subprocess.Popen[str]":
    """Run a recording through the pipeline in a process of its own, which leaves the compiled kernels in the cache."""
    return subprocess.Popen([sys.executable, "-c", CODE], cwd=ROOT, stderr=subprocess.PIPE, text=True)


def wait_for_compiler(process: "subprocess.Popen[str]") -> None:
    """Return once the process has ended; raise `RuntimeError` with its error output if it has failed."""
    _, errors = process.communicate()
    if process.returncode:
        raise RuntimeError(f"the kernels cannot be compiled:\n{errors}")
