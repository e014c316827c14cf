"""A User-Mode Linux kernel, booted on the host's own files for one program.

The guest sees the host's root file system read-only, except for one folder, where the program's
output and exit status are left. It needs no privileges and no terminal, and each boot is a machine
of its own, so any number may run side by side. A boot and its end take about two seconds.
"""

from __future__ import annotations

import os
import re
import shlex
import shutil
import signal
import subprocess
from collections.abc import Sequence
from pathlib import Path

from socketcan.machine import SETUP, Completed, environment

KERNEL = "linux.uml"
MODULES = Path("/usr/lib/uml/modules")
DRIVERS = (
    *("net/can/can", "net/can/can-raw", "drivers/net/can/dev/can-dev", "drivers/net/can/vcan"),
    "net/sched/sch_netem",  # makes a bus as slow as real ones
)
MEMORY_MB = 768
WIDE_REGISTERS = Path(__file__).with_name("wide_registers.c")
BOOT_TIMEOUT_S = 60.0  # a boot takes 1.7 s; a machine that is busy with other tests takes longer


def missing() -> str | None:
    """The first thing that a boot needs and this machine lacks."""
    needed = [KERNEL, "insmod", "ip", "timeout"]
    needed += ["cc"] if _has_wide_registers() else []
    return next((name for name in needed if shutil.which(name, path=_path()) is None), None)


def run_in_uml(command: Sequence[str], work: Path, timeout_s: float) -> Completed:
    """Boot, run `command` in the folder `work`, halt; RuntimeError if the guest did not come up."""
    return boot(_init(command, work, timeout_s), work, timeout_s)


def boot(script: str, work: Path, timeout_s: float) -> Completed:
    """Boot with a shell script as the first process, until the guest powers off.

    The script sees that a program writes what it says, and its exit status, into `stdout`, `stderr`
    and `status` of the folder `machine_folder(work)`. RuntimeError if there is no status.
    """
    machine = machine_folder(work)
    machine.mkdir()
    init = machine / "init"
    init.write_text(script, encoding="utf-8")
    init.chmod(0o755)
    console = _boot(init, timeout_s + BOOT_TIMEOUT_S)
    status, stdout, stderr = (machine / name for name in ("status", "stdout", "stderr"))
    if not status.exists():
        raise RuntimeError(f"the User-Mode Linux guest did not run the program:\n{console}")
    return Completed(int(status.read_text()), stdout.read_text(), stderr.read_text())


def machine_folder(work: Path) -> Path:
    """Where the machine that works in `work` keeps what is its own."""
    return work / "uml"


def insert(drivers: Sequence[str]) -> str:
    """Shell lines that load modules of the kernel."""
    return "\n".join(f'insmod "{MODULES}/$(uname -r)/kernel/{name}.ko"' for name in drivers)


def exports(work: Path) -> str:
    """Shell lines that set what a program finds in its environment."""
    return "\n".join(f"export {k}={shlex.quote(v)}" for k, v in environment(work).items())


def to_its_end(command: Sequence[str], work: Path, timeout_s: float) -> str:
    """Shell lines that run the command in `work` and leave what `boot` asks for."""
    machine = shlex.quote(str(machine_folder(work)))
    return f"""cd {shlex.quote(str(work))}
status=0
timeout --kill-after=1 {timeout_s} {shlex.join(command)} \\
    < /dev/null > {machine}/stdout 2> {machine}/stderr || status=$?
echo $status > {machine}/status"""


def _init(command: Sequence[str], work: Path, timeout_s: float) -> str:
    """The guest's first process: a shell script that powers the guest off, however it ends."""
    return f"""#!/bin/sh -e
trap 'sync; echo o > /proc/sysrq-trigger; sleep 60' EXIT
{exports(work)}
mount -t proc proc /proc
mount -t sysfs sysfs /sys
mkdir -p /dev/shm
mount -t tmpfs tmpfs /dev/shm
# On a busy machine the guest stands still for seconds: no message may be lost meanwhile.
echo 8388608 > /proc/sys/net/core/rmem_default
mount -t hostfs -o {shlex.quote(str(work))} none {shlex.quote(str(work))}
{insert(DRIVERS)}
{SETUP}
{to_its_end(command, work, timeout_s)}
"""


def _boot(init: Path, timeout_s: float) -> str:
    """Run the kernel until it powers off, or kill it; what its console said."""
    console = init.with_name("console")
    with console.open("wb") as output:
        kernel = subprocess.Popen(
            [
                *(KERNEL, f"mem={MEMORY_MB}M", "rootfstype=hostfs", "rootflags=/", "ro"),
                *(f"init={init}", f"uml_dir={init.parent}/", "umid=guest"),
                *("con=null", "con0=fd:0,fd:1", "quiet"),
            ],
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            env={"PATH": _path(), "TMPDIR": _memory_folder(init.parent)} | _preloaded(init.parent),
            start_new_session=True,
        )
        try:
            kernel.wait(timeout_s)
        except subprocess.TimeoutExpired:
            os.killpg(kernel.pid, signal.SIGKILL)
            kernel.wait()
    return console.read_text(errors="replace")


def _has_wide_registers() -> bool:
    """Whether this processor has registers that the kernel does not know (`WIDE_REGISTERS`)."""
    flags = re.search(r"^flags\s*:.*", Path("/proc/cpuinfo").read_text(), re.MULTILINE)
    return flags is not None and "amx_tile" in flags[0].split()


def _preloaded(machine: Path) -> dict[str, str]:
    """What makes the kernel run on such a processor, as variables for it; elsewhere nothing."""
    if not _has_wide_registers():
        return {}
    library = machine / "wide_registers.so"
    build = ["cc", "-O2", "-shared", "-fPIC", "-o", str(library), str(WIDE_REGISTERS)]
    subprocess.run(build, check=True, env={"PATH": _path()})
    return {"LD_PRELOAD": str(library)}


def _memory_folder(otherwise: Path) -> str:
    """Where the guest's memory lies as a file: in RAM where there is room for it."""
    shared = Path("/dev/shm")
    roomy = shared.is_dir() and shutil.disk_usage(shared).free > MEMORY_MB << 20
    return str(shared if roomy else otherwise)


def _path() -> str:
    return os.environ["PATH"] + ":/usr/sbin:/sbin"
