"""A Slurm of one node on this machine: slurmctld, slurmd and munged in a folder.

`python -m tests.cluster COMMAND …` runs a command (say, bash) on one. The daemons are
children that die with their parent, on free ports, so that nothing is left behind and
nothing that is left can be in the way.
"""

from __future__ import annotations

import contextlib
import ctypes
import getpass
import os
import secrets
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

DAEMONS = ("munged", "slurmctld", "slurmd")
SBIN = os.pathsep.join([os.environ["PATH"], "/usr/sbin", "/sbin"])
CONF = """
ClusterName=test
SlurmctldHost={host}(127.0.0.1)
SlurmUser={user}
SlurmdUser={user}
SlurmctldPort={ports[0]}
SlurmdPort={ports[1]}
AuthType=auth/munge
# A job that was requeued waits for as long as its old credential lives.
AuthInfo=socket={folder}/munge.socket,cred_expire=5
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
MpiDefault=none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU
AccountingStorageType=accounting_storage/none
JobAcctGatherType=jobacct_gather/none
SwitchType=switch/none
JobRequeue=1
KillWait=10
ReturnToService=2
NodeName={host} NodeAddr=127.0.0.1 CPUs={cores} RealMemory={memory} State=UNKNOWN
PartitionName=main Nodes=ALL Default=YES MaxTime=INFINITE State=UP
"""


def missing() -> list[str]:
    """The programs of Slurm that aren't installed."""
    return [name for name in (*DAEMONS, "sbatch") if not shutil.which(name, path=SBIN)]


@contextlib.contextmanager
def running(seconds: float = 30.0) -> Iterator[dict[str, str]]:
    """The environment in which Slurm's commands reach a cluster that is ready.

    RuntimeError, with the daemons' logs, if it isn't within `seconds`.
    """
    # Not below a private folder: munge's socket has to be within everyone's reach.
    folder = Path(tempfile.mkdtemp(prefix="slurm_"))
    folder.chmod(0o711)
    for name in ("state", "spool"):
        (folder / name).mkdir(mode=0o755)
    conf, key = folder / "slurm.conf", folder / "munge.key"
    host = socket.gethostname().partition(".")[0]
    machine = {"host": host, "user": getpass.getuser(), "cores": os.cpu_count()}
    machine["memory"] = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") >> 20
    conf.write_text(CONF.format(folder=folder, ports=_free_ports(2), **machine))
    key.touch(mode=0o600)
    key.write_bytes(secrets.token_bytes(128))
    environment = {**os.environ, "SLURM_CONF": str(conf), "PATH": SBIN}
    own = {name: f"{folder}/munge.{name}" for name in ("socket", "pid", "seed", "log")}
    munged = ["munged", "--foreground", "--force", f"--key-file={key}"]
    munged += [f"--socket={own['socket']}", f"--pid-file={own['pid']}"]
    munged += [f"--seed-file={own['seed']}", f"--log-file={own['log']}"]
    daemons = []
    try:
        for command in (
            munged,
            ["slurmctld", "-D", "-i", "-f", str(conf)],
            ["slurmd", "-D", "-f", str(conf), "-N", host],
        ):
            daemons.append(_start(command, folder, environment))
        end = time.monotonic() + seconds
        while _output(["sinfo", "--noheader", "--format=%T"], environment) != "idle":
            ended = [d.args[0] for d in daemons if d.poll() is not None]
            if ended or time.monotonic() > end:
                logs = [path.read_text()[-2000:] for path in folder.glob("*.log")]
                what = f"{ended} ended" if ended else f"not ready in {seconds} s"
                raise RuntimeError("\n".join([f"Slurm: {what}", *logs]))
            time.sleep(0.2)
        yield environment
    finally:
        _output(["scancel", "--signal=KILL", "--full", "--me"], environment)
        for daemon in reversed(daemons):
            daemon.terminate()
            with contextlib.suppress(subprocess.TimeoutExpired):
                daemon.wait(10)
            daemon.kill()
        shutil.rmtree(folder, ignore_errors=True)


def _start(command: list[str], folder: Path, environment: dict) -> subprocess.Popen:
    """A daemon in the foreground, its words in a log, that dies with this process."""
    libc = ctypes.CDLL(None)
    with open(folder / f"{command[0]}.log", "wb") as log:
        return subprocess.Popen(
            command,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            preexec_fn=lambda: libc.prctl(1, signal.SIGKILL),  # PR_SET_PDEATHSIG
        )


def _output(command: list[str], environment: dict) -> str:
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    return done.stdout.strip()


def _free_ports(count: int) -> list[int]:
    with contextlib.ExitStack() as stack:
        sockets = [stack.enter_context(socket.socket()) for _ in range(count)]
        for each in sockets:
            each.bind(("127.0.0.1", 0))
        return [each.getsockname()[1] for each in sockets]


if __name__ == "__main__":
    with running() as ready:
        sys.exit(subprocess.call(sys.argv[1:] or ["bash"], env=ready))
