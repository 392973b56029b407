"""A Slurm of one node on this machine: slurmctld, slurmd and munged in a folder.

The daemons are children that die with their parent, on free ports.
"""

import contextlib
import getpass
import os
import secrets
import shutil
import socket
import subprocess
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

SBIN = os.pathsep.join([os.environ["PATH"], "/usr/sbin", "/sbin"])
CONF = Path(__file__).with_name("slurm.conf").read_text()


@contextlib.contextmanager
def running(seconds: float = 30.0) -> Iterator[dict[str, str]]:
    """The environment in which Slurm's commands reach a cluster that is ready."""
    # Not below a private folder: munge's socket has to be within everyone's reach.
    folder = Path(tempfile.mkdtemp(prefix="slurm_"))
    folder.chmod(0o711)
    for name in ("state", "spool"):
        (folder / name).mkdir(mode=0o755)
    conf, key = folder / "slurm.conf", folder / "munge.key"
    host = socket.gethostname().partition(".")[0]
    machine = {"host": host, "user": getpass.getuser(), "cores": os.cpu_count()}
    machine["memory"] = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") >> 20
    conf.write_text(CONF.format(folder=folder, ports=_free_ports(), **machine))
    key.touch(mode=0o600)
    key.write_bytes(secrets.token_bytes(128))
    environment = {**os.environ, "SLURM_CONF": str(conf), "PATH": SBIN}
    own = [f"--{n}-file={folder}/munge.{n}" for n in ("key", "pid", "seed", "log")]
    commands = [
        ["munged", "--foreground", "--force", f"--socket={folder}/munge.socket", *own],
        ["slurmctld", "-D", "-i", "-f", str(conf)],
        ["slurmd", "-D", "-f", str(conf), "-N", host],
    ]
    daemons = []
    try:
        for command in commands:
            with open(folder / f"{command[0]}.log", "wb") as log:
                streams = {"stdin": subprocess.DEVNULL, "stdout": log, "stderr": log}
                mortal = ["setpriv", "--pdeathsig=KILL", *command]
                daemons.append(subprocess.Popen(mortal, env=environment, **streams))
        end = time.monotonic() + seconds
        while _output(["sinfo", "--noheader", "--format=%T"], environment) != "idle":
            ended = [d.args[2] for d in daemons if d.poll() is not None]
            if ended or time.monotonic() > end:
                logs = [path.read_text()[-2000:] for path in folder.glob("*.log")]
                raise RuntimeError("\n".join([f"Slurm isn't ready; {ended=}", *logs]))
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


def _output(command: list[str], environment: dict) -> str:
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    return done.stdout.strip()


def _free_ports() -> list[int]:
    with socket.create_server(("", 0)) as one, socket.create_server(("", 0)) as other:
        return [one.getsockname()[1], other.getsockname()[1]]
