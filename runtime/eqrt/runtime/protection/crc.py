"""Cyclic redundancy checks of eight and sixteen bits, most significant bit first.

Names and parameters are those of AUTOSAR's "Specification of CRC Routines": CRC-16 is polynomial
0x1021 from 0xFFFF (CCITT-FALSE), CRC-8-H2F polynomial 0x2F from 0xFF, inverted at the end.
"""

from __future__ import annotations

import binascii
from collections.abc import Callable
from functools import cache

import numpy as np
from numpy.typing import NDArray

CCITT = 0x1021
H2F = 0x2F

Crc = Callable[[bytes], int]


def crc16(data: bytes) -> int:
    """AUTOSAR's CRC-16; 0x29B1 for the nine digits."""
    return binascii.crc_hqx(data, 0xFFFF)


def crc8_h2f(data: bytes) -> int:
    """AUTOSAR's CRC-8-H2F; 0xDF for the nine digits."""
    return _h2f()(data)


def crc_of(bits: int, polynomial: int, start: int, final_xor: int) -> Crc:
    """A function that computes the check of `bits` (8 or 16) with these parameters."""
    if (bits, polynomial) == (16, CCITT):  # the one that the standard library has in C
        return lambda data: binascii.crc_hqx(data, start) ^ final_xor
    table, behind = _table(bits, polynomial), bits - 8  # the register's first byte, the bits behind
    rest = (1 << behind) - 1

    def crc(data: bytes) -> int:
        value = start
        for byte in data:
            value = (value & rest) << 8 ^ table[value >> behind ^ byte]
        return value ^ final_xor

    return crc


def crc8_h2f_rows(rows: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """(M,) CRC-8-H2F of every row of (M, W) bytes.

    A CRC is affine in its bits: the check of a message is that of zeros, exclusive or what each of
    its bytes adds in its place. So there is a table per place, and all rows are looked up at once.
    """
    tables, of_zeros = _place_tables(rows.shape[1])
    added = tables[np.arange(rows.shape[1]), rows]  # (M, W)
    checks: NDArray[np.uint8] = np.bitwise_xor.reduce(added, axis=1) ^ of_zeros
    return checks


@cache
def _h2f() -> Crc:
    return crc_of(8, H2F, 0xFF, 0xFF)


@cache
def _table(bits: int, polynomial: int) -> tuple[int, ...]:
    """What a byte at the top of the register becomes when it is shifted out."""
    table, top, mask = [], 1 << (bits - 1), (1 << bits) - 1
    for byte in range(256):
        value = byte << (bits - 8)
        for _ in range(8):
            value = (value << 1 & mask) ^ (polynomial if value & top else 0)
        table.append(value)
    return tuple(table)


@cache
def _place_tables(width: int) -> tuple[NDArray[np.uint8], np.uint8]:
    """((W, 256) what a byte adds to the CRC-8-H2F in each of W places, that of W zeros)."""
    step = np.array(_table(8, H2F), np.uint8)
    tables = np.empty((width, 256), np.uint8)
    moved = step
    for place in range(width - 1, -1, -1):
        tables[place] = moved
        moved = step[moved]
    return tables, np.uint8(crc8_h2f(bytes(width)))
