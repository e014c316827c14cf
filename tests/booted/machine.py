"""A User-Mode Linux kernel whose first process is systemd: a small computer as in a car.

It is booted on the host's own files, which it sees read-only; /etc is a copy that may be changed,
/var, /opt and /tmp are empty. eqrt lies in /opt/eqrt as deploy/README.md puts it there, but for the
files themselves, which are the host's, mounted: units with ProtectHome= would not see them where
they are. One program runs as root and ends the machine by its end.
"""

from __future__ import annotations

import shlex
import sys
import sysconfig
from collections.abc import Sequence
from pathlib import Path

from socketcan import uml
from socketcan.machine import SETUP, Completed
from source_tree import ROOT

SYSTEMD = Path("/lib/systemd/systemd")
EMPTY = ("/var", "/opt", "/tmp")
DRIVERS = (*uml.DRIVERS, "fs/overlayfs/overlay")
HOME = Path("/opt/eqrt")
PYTHON = f"python{sys.version_info.major}.{sys.version_info.minor}"
PROGRAM = f"""#!{HOME}/bin/python
import sys
from eqrt.cli import main
sys.exit(main())
"""
INSTALLED = {
    "python": Path(sys.base_prefix),
    "packages": Path(sysconfig.get_path("purelib")),
    "runtime": ROOT / "runtime",
}
"""Folders of HOME, and where the files are."""
VIRTUAL_ENVIRONMENT = f"""mkdir -p {HOME}/bin {HOME}/lib/{PYTHON}/site-packages
ln -s {HOME}/python/bin/{PYTHON} {HOME}/bin/python
echo "home = {HOME}/python/bin" > {HOME}/pyvenv.cfg
printf '%s\\n' {HOME}/packages {HOME}/runtime > {HOME}/lib/{PYTHON}/site-packages/eqrt.pth
cat > {HOME}/bin/eqrt <<'END'
{PROGRAM}END
chmod 755 {HOME}/bin/eqrt"""
FIRST_PROGRAM = """[Unit]
DefaultDependencies=no
Wants=systemd-journald.service dbus.socket
After=systemd-journald.service dbus.socket
[Service]
Type=oneshot
ExecStart=/bin/sh /run/first-program
ExecStopPost=/bin/systemctl poweroff --force --force
"""


def missing() -> str | None:
    """The first thing that a boot needs and this machine lacks."""
    return uml.missing() or (None if SYSTEMD.exists() else str(SYSTEMD))


def run_beside_systemd(command: Sequence[str], work: Path, timeout_s: float) -> Completed:
    """Boot, run `command` in the folder `work` when systemd is up, power off."""
    return uml.boot(_init(command, work, timeout_s), work, timeout_s)


def _init(command: Sequence[str], work: Path, timeout_s: float) -> str:
    """A shell script that prepares the machine and becomes systemd."""
    mounts = {ROOT: ROOT}  # it may have been in one of the folders that are empty now
    mounts |= {HOME / name: files for name, files in INSTALLED.items()}
    empty = "\n".join(f"mount -t tmpfs tmpfs {path}" for path in EMPTY)
    mounted = "\n".join(_mounted(*pair) for pair in mounts.items())
    return f"""#!/bin/sh -e
{uml.exports(work)}
mount -t proc proc /proc
mount -t sysfs sysfs /sys
mount -t tmpfs tmpfs /run
{uml.insert(DRIVERS)}
mkdir -p /run/etc/changed /run/etc/work
mount -t overlay -o lowerdir=/etc,upperdir=/run/etc/changed,workdir=/run/etc/work overlay /etc
{empty}
mkdir -p /var/lib /var/log /var/tmp {shlex.quote(str(work))}
mount -t hostfs -o {shlex.quote(str(work))} none {shlex.quote(str(work))}
{mounted}
{VIRTUAL_ENVIRONMENT}
{SETUP}
cat > /run/first-program <<'END'
{uml.exports(work)}
{uml.to_its_end(command, work, timeout_s)}
sync
END
mkdir -p /run/systemd/system
cat > /run/systemd/system/first-program.service <<'END'
{FIRST_PROGRAM}END
exec {SYSTEMD} --unit=first-program.service --log-target=null --show-status=false
"""


def _mounted(place: Path, files: Path) -> str:
    here, there = shlex.quote(str(place)), shlex.quote(str(files))
    return f"mkdir -p {here}\nmount -r -t hostfs -o {there} none {here}"
