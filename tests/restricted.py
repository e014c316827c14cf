"""Run a program with the sockets that deploy/eqrt.service leaves it: restricted.py PROGRAM...

By a filter in the kernel (seccomp), as systemd does it; other families are EAFNOSUPPORT.
"""

from __future__ import annotations

import ctypes
import errno
import os
import platform
import re
import socket
import struct
import sys

from source_tree import ROOT

UNIT = ROOT / "deploy/eqrt.service"
_SOCKET = {"x86_64": 41, "aarch64": 198}  # the system call's number
_LOAD, _EQUAL, _RETURN = 0x20, 0x15, 0x06  # BPF_LD|BPF_W|BPF_ABS, BPF_JMP|BPF_JEQ, BPF_RET
_NUMBER_AT, _FAMILY_AT = 0, 16  # in struct seccomp_data
_ALLOW, _REFUSE = 0x7FFF0000, 0x00050000
_NO_NEW_PRIVILEGES, _SET_SECCOMP, _FILTER = 38, 22, 2  # prctl(2)


def allowed() -> list[int]:
    """The families that the unit names."""
    line = re.search(r"^RestrictAddressFamilies=(.*)$", UNIT.read_text(encoding="utf-8"), re.M)
    assert line is not None
    return [int(getattr(socket, name)) for name in line[1].split()]


def restrict() -> None:
    """This process from now on, and what it becomes."""
    families = allowed()
    steps = [
        (_LOAD, 0, 0, _NUMBER_AT),
        (_EQUAL, 0, len(families) + 2, _SOCKET[platform.machine()]),
        (_LOAD, 0, 0, _FAMILY_AT),
        *((_EQUAL, len(families) - n, 0, family) for n, family in enumerate(families)),
        (_RETURN, 0, 0, _REFUSE | errno.EAFNOSUPPORT),
        (_RETURN, 0, 0, _ALLOW),
    ]
    code = ctypes.create_string_buffer(b"".join(struct.pack("HBBI", *step) for step in steps))
    program = struct.pack("HxxxxxxP", len(steps), ctypes.addressof(code))
    libc = ctypes.CDLL(None, use_errno=True)
    libc.prctl(_NO_NEW_PRIVILEGES, 1, 0, 0, 0)
    if libc.prctl(_SET_SECCOMP, _FILTER, program, 0, 0):
        raise OSError(ctypes.get_errno(), "no seccomp in this kernel")


if __name__ == "__main__":
    restrict()
    os.execv(sys.argv[1], sys.argv[1:])
