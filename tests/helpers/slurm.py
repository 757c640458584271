"""A SLURM of one node for tests: its daemons run as this user, from ``PATH`` or from unpacked packages.

``SLURM_ROOT`` names a folder into which the Debian packages slurmctld, slurmd, slurm-client, slurm-wlm-basic-plugins
and libhwloc15 were unpacked with ``dpkg -x``.
"""

from __future__ import annotations

import os
import platform
import shutil
import subprocess
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import NamedTuple

from helpers.processes import ended_with_tests, free_port, wait_for

CONFIG = """
ClusterName=test
SlurmctldHost={host}(127.0.0.1)
AuthType=auth/none
CredType=cred/none
SlurmUser={user}
SlurmdUser={user}
SlurmctldPort={ports[0]}
SlurmdPort={ports[1]}
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/slurmd.log
{plugins}
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU
SwitchType=switch/none
MpiDefault=none
JobAcctGatherType=jobacct_gather/none
AccountingStorageType=accounting_storage/none
ReturnToService=2
MailProg=/bin/true
SchedulerParameters=sched_interval=2,bf_interval=2,batch_sched_delay=0
NodeName={host} NodeAddr=127.0.0.1 CPUs=2 State=UNKNOWN
PartitionName=all Nodes=ALL Default=YES MaxTime=INFINITE State=UP
"""


class Slurm(NamedTuple):
    """Run the commands of a SLURM that runs."""

    binaries: dict[str, Path]
    env: dict[str, str]

    def __call__(self, command: str, *arguments: object, cwd: Path | None = None) -> str:
        """Run a command and return what it prints."""
        done = subprocess.run(
            [str(self.binaries[command]), *map(str, arguments)], env=self.env, cwd=cwd, capture_output=True, text=True,
            check=False,
        )  # fmt: skip
        assert done.returncode == 0, (command, arguments, done.stderr)
        return done.stdout.strip()

    def submit(self, script: Path, *arguments: object, cwd: Path) -> str:
        """Submit a script and return the number of its job."""
        return self("sbatch", "--parsable", *arguments, script, cwd=cwd)

    def wait(self, seconds: float = 300) -> None:
        """Wait until no job is waiting or running."""
        wait_for(lambda: self("squeue", "--noheader") == "", seconds=seconds)


def find_binaries() -> dict[str, Path] | None:
    """Return the programs of SLURM by name, None if one is missing."""
    root = os.environ.get("SLURM_ROOT")
    folders = [Path(root, "usr", folder) for folder in ("sbin", "bin")] if root else None
    found: dict[str, Path] = {}
    for name in ("slurmctld", "slurmd", "slurmstepd", "sbatch", "squeue", "scontrol", "sinfo"):
        path = shutil.which(name, path=os.pathsep.join(map(str, folders))) if folders else shutil.which(name)
        path = path or (shutil.which(f"{name}-wlm", path=os.pathsep.join(map(str, folders))) if folders else None)
        if path is None:
            return None
        found[name] = Path(path)
    return found


@contextmanager
def running_slurm(folder: Path, binaries: dict[str, Path]) -> Iterator[Slurm]:
    """Start the daemons of a SLURM of one node in a folder; end them afterwards."""
    env = dict(os.environ)
    plugins = ""
    if root := os.environ.get("SLURM_ROOT"):
        (libraries,) = Path(root, "usr/lib").glob("*-linux-gnu")
        env["LD_LIBRARY_PATH"] = f"{libraries}:{libraries / 'slurm-wlm'}"
        plugins = f"PluginDir={libraries / 'slurm-wlm'}"
    for name in ("state", "spool"):
        (folder / name).mkdir()
    config = folder / "slurm.conf"
    user = os.environ.get("USER", "root")
    config.write_text(
        CONFIG.format(host=platform.node(), user=user, folder=folder, plugins=plugins, ports=[free_port(), free_port()])
    )
    env["SLURM_CONF"] = str(config)
    commands = [
        [binaries["slurmctld"], "-D", "-c"],
        [binaries["slurmd"], "-D", "-d", binaries["slurmstepd"]],
    ]
    with ExitStack() as stack:
        for command in commands:
            with (folder / f"{Path(command[0]).name}.out").open("w") as log:
                arguments = [*map(str, command)]
                daemon = subprocess.Popen(arguments, env=env, stdout=log, stderr=log, start_new_session=True)
            stack.callback(daemon.wait)
            stack.callback(daemon.terminate)
            stack.enter_context(ended_with_tests(daemon))
            time.sleep(2)
        slurm = Slurm(binaries, env)
        wait_for(lambda: "idle" in slurm("sinfo", "--noheader"), seconds=60)
        yield slurm
