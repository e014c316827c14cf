"""Messages of an INS of SBG Systems, which tells its place by latitude and longitude."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import can
import cantools.database

import eqrt.runtime.decoding.profile
from tiny_sensor import message

_DBC = Path(eqrt.runtime.decoding.profile.__file__).parent / "dbc" / "sbg" / "sbgCan.dbc"


def sbg_messages(
    latitude_deg: float, longitude_deg: float, heading_rad: float
) -> list[can.Message]:
    """What the INS sends of a fix that is good to 10 cm, from its published DBC."""
    database: Any = cantools.database.load_file(_DBC)
    values = {
        "SBG_ECAN_MSG_EKF_EULER": {"ROLL": 0, "PITCH": 0, "YAW": heading_rad},
        "SBG_ECAN_MSG_EKF_POS": {"LATITUDE": latitude_deg, "LONGITUDE": longitude_deg},
        "SBG_ECAN_MSG_EKF_POS_ACC": dict.fromkeys(
            ("LATITUDE_ACC", "LONGITUDE_ACC", "ALTITUDE_ACC"), 0.1
        ),
    }
    definitions = [(database.get_message_by_name(name), value) for name, value in values.items()]
    return [message(d.frame_id, d.encode(value)) for d, value in definitions]
