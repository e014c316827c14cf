"""Recordings for other programs, read back with those programs' own libraries."""

from __future__ import annotations

import json
import math
import os
import time
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import mcap.reader
import msgpack
import numpy as np
import pytest
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from rosbags.highlevel import AnyReader

from bridging import bridge
from drives import DRIVES, first_seconds, shipped_predictor
from eqrt.cli import main
from eqrt.export.bridges.moments import Moment
from eqrt.export.bridges.ros2 import PREDICTED_OBJECTS, TOPIC, autoware_types, moved_on
from eqrt.runtime.bus.buses import LOCAL
from eqrt.runtime.bus.candump import candump_line, candump_message
from eqrt.runtime.bus.health import BusHealth
from eqrt.runtime.decoding.detections import ObjectClass
from eqrt.runtime.decoding.profile import load_profile
from eqrt.runtime.output.forecasts import ForecastSet, Mode
from eqrt.runtime.output.json_lines import json_lines
from eqrt.runtime.output.status import ServiceStatus
from eqrt.runtime.pipeline import Pipeline
from eqrt.runtime.prediction.tiles import load_tile
from eqrt.runtime.recording.identity import attached_files, identity_of
from eqrt.runtime.recording.json_schemas import json_schema
from eqrt.runtime.recording.order import Description, Order
from eqrt.runtime.recording.reader import Recording, read_recordings
from eqrt.runtime.recording.recorder import Recorder
from eqrt.runtime.recording.runs import RunTape
from eqrt.runtime.recording.steps import Lost, TapedClock
from eqrt.runtime.status_book import StatusBook
from forecast_sets import nobody, one_car
from plotjuggler import curves, plotjuggler_server, series
from processes import PATIENCE_S, Serving, files_of_at_most, playing
from source_tree import ROOT

NGSIM = DRIVES["ngsim"]


class Nowhere:
    """No bus."""

    def health(self) -> list[BusHealth]:
        return []

    def counts(self) -> dict[str, int]:
        return {}


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """Two seconds of NGSIM, with its tile and one status."""
    folder = tmp_path_factory.mktemp("recording")
    now_s = 0.0
    clock = TapedClock(lambda: now_s)  # no time passes while it computes
    assert NGSIM.tile is not None
    tile = load_tile(NGSIM.tile)
    pipeline = Pipeline(load_profile("generic"), shipped_predictor(), tile, clock=clock)
    with Recorder(order_of(folder, pipeline), clock, RunTape()) as recorder:
        book = StatusBook(pipeline, Nowhere(), [recorder])
        for line in first_seconds(NGSIM.log, 2.0).splitlines():
            message = candump_message(line)
            now_s = message.timestamp
            recorder.begin(message, now_s)
            for forecast in [*pipeline.poll(now_s), *pipeline.feed(message, now_s)]:
                recorder.publish(forecast)
            recorder.end()
        recorder.report(book.close(time.monotonic() + 1.0))
    (found,) = read_recordings(folder)
    return found


def order_of(folder: Path, pipeline: Pipeline) -> Order:
    return Order(
        folder=str(folder),
        run="00c0ffee",
        description=Description(
            identity=identity_of(pipeline, model_folder=Path(), channels=None, stationary=False),
            attached=attached_files("generic", pipeline),
        ),
        schemas={"/eqrt/status": json_schema(ServiceStatus), "/eqrt/lost": json_schema(Lost)},
        file_bytes=1 << 30,
        file_seconds=600.0,
        total_bytes=1 << 40,
        free_bytes=0,
        delete_oldest=False,
    )


def convert(recording: Recording, kind: str, out: Path) -> None:
    assert main(["convert", str(recording.paths[0]), "--to", kind, "--out", str(out)]) == 0


# --- Foxglove


@pytest.fixture(scope="module")
def shown(
    recording: Recording, tmp_path_factory: pytest.TempPathFactory
) -> dict[str, list[tuple[int, bytes]]]:
    return shown_of(recording, tmp_path_factory.mktemp("foxglove") / "drive.mcap")


def shown_of(recording: Recording, file: Path) -> dict[str, list[tuple[int, bytes]]]:
    """Topic -> time and content of its messages, as mcap's indexed reader finds them."""
    convert(recording, "foxglove", file)
    found: dict[str, list[tuple[int, bytes]]] = {}
    with file.open("rb") as stream:
        for schema, channel, message in mcap.reader.make_reader(stream).iter_messages():
            assert schema is not None
            found.setdefault(channel.topic, []).append((message.log_time, message.data))
            if schema.encoding == "protobuf":
                assert parsed_by_its_own_schema(schema.name, schema.data, message.data)
    return found


def parsed_by_its_own_schema(name: str, schema: bytes, content: bytes) -> object:
    """What a program can read that knows the file alone."""
    pool = descriptor_pool.DescriptorPool()
    for file in descriptor_pb2.FileDescriptorSet.FromString(schema).file:
        pool.Add(file)
    kind = message_factory.GetMessageClass(pool.FindMessageTypeByName(name))
    return kind.FromString(content)


def test_foxglove_sees_every_target_where_it_is(
    recording: Recording, shown: dict[str, list[tuple[int, bytes]]]
) -> None:
    forecasts = list(recording.forecasts())
    scenes = [SceneUpdate.FromString(content) for _, content in shown["/scene"]]
    assert len(scenes) == len(forecasts) > 15
    for scene, forecast in zip(scenes, forecasts, strict=True):
        assert len(scene.entities) == forecast.num_targets
        for row, entity in enumerate(scene.entities):
            assert (entity.frame_id, entity.id) == ("map", f"track {forecast.track_id[row]}")
            (box,) = entity.cubes
            place = (box.pose.position.x, box.pose.position.y)
            np.testing.assert_allclose(place, forecast.position[row])
            _, *modes = entity.lines
            points = [[(p.x, p.y) for p in line.points[1:]] for line in modes]
            np.testing.assert_allclose(points, forecast.trajectories[row])
            strength = [line.color.a for line in modes]
            assert strength == sorted(strength, reverse=True)


def test_foxglove_knows_where_the_ego_vehicle_is(
    recording: Recording, shown: dict[str, list[tuple[int, bytes]]]
) -> None:
    last = list(recording.forecasts())[-1]
    transform = FrameTransform.FromString(shown["/tf"][-1][1])
    assert (transform.parent_frame_id, transform.child_frame_id) == ("map", "ego")
    assert last.map_from_ego is not None
    assert transform.translation.x == last.map_from_ego.x_m
    yaw_rad = 2.0 * math.atan2(transform.rotation.z, transform.rotation.w)
    assert math.cos(yaw_rad - last.map_from_ego.yaw_rad) == pytest.approx(1.0)


def recording_of(folder: Path, *cycles: ForecastSet) -> Recording:
    """What a service would have recorded that said this."""
    pipeline = Pipeline(load_profile("generic"), shipped_predictor())
    with Recorder(order_of(folder, pipeline), TapedClock(lambda: 0.0), RunTape()) as recorder:
        for forecasts in cycles:
            recorder.publish(forecasts)
    (recording,) = read_recordings(folder)
    return recording


def test_foxglove_is_told_no_place_of_an_ego_vehicle_whose_place_is_not_known(
    tmp_path: Path,
) -> None:
    nowhere = replace(nobody(), map_from_ego=None, ego_speed_mps=math.nan)
    recording = recording_of(tmp_path, one_car(), nowhere)
    found = shown_of(recording, tmp_path / "drive.mcap")
    known, unknown = (json.loads(content) for _, content in found["/cycle"])
    ego = ("ego_x", "ego_y", "ego_yaw", "ego_speed")
    assert [known[name] for name in ego] == pytest.approx([100.0, 200.0, math.pi / 2, 8.0])
    assert [unknown[name] for name in ego] == [None] * 4
    assert len(found["/tf"]) == 1


def test_without_a_map_pose_foxglove_shows_nobody_in_the_map(tmp_path: Path) -> None:
    """The places are those of the ego vehicle's own dead reckoning."""
    found = shown_of(
        recording_of(tmp_path, one_car(), replace(one_car(), mode=Mode.NO_POSE)),
        tmp_path / "drive.mcap",
    )
    frames = [
        (SceneUpdate.FromString(scene).entities[0].frame_id, FrameTransform.FromString(tf))
        for (_, scene), (_, tf) in zip(found["/scene"], found["/tf"], strict=True)
    ]
    assert [(frame, tf.parent_frame_id) for frame, tf in frames] == [("map", "map"), ("odom",) * 2]
    assert {tf.child_frame_id for _, tf in frames} == {"ego"}


def test_who_is_predicted_no_more_leaves_foxgloves_scene_at_once(tmp_path: Path) -> None:
    later = replace(nobody(), timestamp_s=1000.3, made_s=1000.312)
    found = shown_of(recording_of(tmp_path, one_car(), later), tmp_path / "drive.mcap")
    before, after = (SceneUpdate.FromString(content) for _, content in found["/scene"])
    assert (len(before.entities), len(after.entities)) == (1, 0)
    (deletion,) = after.deletions
    assert deletion.type == deletion.ALL
    assert deletion.timestamp.ToNanoseconds() > before.entities[0].timestamp.ToNanoseconds()


def test_a_box_in_foxglove_looks_where_its_target_does_or_is_none(tmp_path: Path) -> None:
    """A wandering reflection has a velocity, but no direction."""
    car = one_car()
    wandering = replace(car, heading_rad=np.array([np.nan]), velocity=np.array([[0.1, -0.2]]))
    found = shown_of(recording_of(tmp_path, car, wandering), tmp_path / "drive.mcap")
    scenes = [SceneUpdate.FromString(content).entities[0] for _, content in found["/scene"]]
    assert [(len(one.cubes), len(one.cylinders)) for one in scenes] == [(1, 0), (0, 1)]
    turned = scenes[0].cubes[0].pose.orientation
    assert 2.0 * math.atan2(turned.z, turned.w) == pytest.approx(math.pi / 2)
    assert scenes[1].cylinders[0].pose.position.y == 220.0


def test_foxglove_has_the_lanes_of_the_tile_that_predicts(tmp_path: Path) -> None:
    """A tile that was exchanged for none under way."""
    assert NGSIM.tile is not None
    on_tile = Pipeline(load_profile("generic"), shipped_predictor(), load_tile(NGSIM.tile))
    order = order_of(tmp_path, on_tile)
    without = order_of(tmp_path, Pipeline(load_profile("generic"), shipped_predictor()))
    with Recorder(order, TapedClock(lambda: 0.0), RunTape()) as recorder:
        recorder.publish(one_car())
        recorder.describe(without.description)
        recorder.publish(replace(one_car(), cycle=301))
    (recording,) = read_recordings(tmp_path)
    convert_all(recording, tmp_path / "drive.mcap")
    with (tmp_path / "drive.mcap").open("rb") as stream:
        updates = [
            SceneUpdate.FromString(message.data)
            for _, _, message in mcap.reader.make_reader(stream).iter_messages(topics=["/lanes"])
        ]
    assert [len(update.entities) for update in updates] == [1, 0]
    assert updates[1].deletions[0].type == updates[1].deletions[0].ALL


def convert_all(recording: Recording, out: Path) -> None:
    """All files of a run."""
    folder = str(recording.paths[0].parent)
    assert main(["convert", folder, "--to", "foxglove", "--out", str(out)]) == 0


def test_foxglove_has_lanes_numbers_and_a_log(
    recording: Recording, shown: dict[str, list[tuple[int, bytes]]]
) -> None:
    assert NGSIM.tile is not None
    (lanes,) = SceneUpdate.FromString(shown["/lanes"][0][1]).entities
    assert len(lanes.lines) == load_tile(NGSIM.tile).lane_map.num_lanes
    cycles = [json.loads(content) for _, content in shown["/cycle"]]
    objects = [forecast.num_targets for forecast in recording.forecasts()]
    assert [cycle["objects"] for cycle in cycles] == objects
    assert all(
        isinstance(v, int | float) for v in cycles[-1].values()
    )  # flat: PlotJuggler plots it
    assert "predictions/s" in Log.FromString(shown["/log"][0][1]).message
    assert json.loads(shown["/status"][0][1])["profile"] == "generic"
    assert abs(shown["/cycle"][0][0] / 1e9 - time.time()) < 600.0  # the wall clock


def test_foxgloves_layout_shows_topics_that_are_there(
    shown: dict[str, list[tuple[int, bytes]]],
) -> None:
    layout = json.loads((ROOT / "deploy/viewers/foxglove-layout.json").read_text())
    panels = layout["configById"]
    three = next(panel for name, panel in panels.items() if name.startswith("3D!"))
    assert set(three["topics"]) == {"/scene", "/lanes"} <= set(shown)
    plots = [panel for name, panel in panels.items() if name.startswith("Plot!")]
    values = [path["value"] for panel in plots for path in panel["paths"]]
    keys = json.loads(shown["/cycle"][0][1])
    assert values
    for value in values:
        topic, _, field = value.partition(".")
        assert topic == "/cycle"
        assert field in keys


# --- PlotJuggler: what it calls the series of a message is in plotjuggler.py


def test_plotjugglers_layout_of_a_file_shows_fields_that_are_there(
    shown: dict[str, list[tuple[int, bytes]]],
) -> None:
    named = curves(ROOT / "deploy/viewers/plotjuggler-recording.xml")
    there = {
        name
        for topic in ("/cycle", "/status")
        for name, _ in series(json.loads(shown[topic][-1][1]), topic)
    }
    assert named
    assert named <= there


def test_plotjugglers_live_layout_shows_series_that_are_sent() -> None:
    """By a bridge beside a service that hears a drive, in processes of their own."""
    named = curves(ROOT / "deploy/viewers/plotjuggler-live.xml")
    channel = f"plotted-{os.getpid()}"
    there: set[str] = set()
    with (
        plotjuggler_server() as (server, address),
        bridge("--to", "plotjuggler", "--send", address) as (_, datagrams),
        Serving(*NGSIM.options, *on(channel), "--datagrams", datagrams),
        playing(NGSIM.log, "--can", f"can0={channel}"),
    ):
        end_s = time.monotonic() + PATIENCE_S
        while not named <= there:
            assert time.monotonic() < end_s, named - there
            there |= {name for name, _ in series(msgpack.unpackb(server.recv(65_535)))}
    assert named


def on(channel: str) -> list[str]:
    """Options of `eqrt serve`: on a bus of this machine's own."""
    return ["--can", channel, "--can-interface", LOCAL]


@pytest.mark.parametrize("layout", ["plotjuggler-live", "plotjuggler-recording"])
def test_plotjugglers_layouts_say_what_the_numbers_of_modes_mean(layout: str) -> None:
    root = ElementTree.parse(ROOT / f"deploy/viewers/{layout}.xml").getroot()
    (title,) = (area.get("name", "") for area in root.iter("DockArea") if is_of_modes(area))
    told = dict(part.split(" ") for part in title.removeprefix("Mode: ").split(", "))
    assert told == {str(mode.value): mode.name for mode in Mode if mode is not Mode.PARTIAL}


def is_of_modes(area: ElementTree.Element) -> bool:
    return any(curve.get("name", "").endswith("/mode") for curve in area.iter("curve"))


# --- ROS 2


def test_a_bag_has_autowares_predicted_objects(recording: Recording, tmp_path: Path) -> None:
    """Read by rosbags as any bag, with the definitions that lie in it."""
    convert(recording, "rosbag2", tmp_path / "bag")
    forecasts = list(recording.forecasts())
    with AnyReader([tmp_path / "bag"], default_typestore=autoware_types()) as reader:
        (connection,) = reader.connections
        assert (connection.topic, connection.msgtype) == (TOPIC, PREDICTED_OBJECTS)
        read: list[Any] = [
            reader.deserialize(content, connection.msgtype) for _, _, content in reader.messages()
        ]
    assert len(read) == len(forecasts)
    for message, forecast in zip(read, forecasts, strict=True):
        assert message.header.frame_id == "map"
        assert len(message.objects) == forecast.num_targets
        for row, one in enumerate(message.objects):
            kinematics = one.kinematics
            assert bytes(one.object_id.uuid)[8:] == int(forecast.track_id[row]).to_bytes(8, "big")
            confidence = [path.confidence for path in kinematics.predicted_paths]
            np.testing.assert_allclose(confidence, forecast.probabilities[row], atol=1e-6)
            assert (kinematics.predicted_paths[0].time_step.nanosec) == 100_000_000
            expected = moved_on(forecast, row, 0)
            path = [(p.position.x, p.position.y) for p in kinematics.predicted_paths[0].path]
            np.testing.assert_allclose(path, expected)


def objects_of(folder: Path, *cycles: ForecastSet) -> list[Any]:
    """The messages of a bag."""
    convert(recording_of(folder, *cycles), "rosbag2", folder / "bag")
    with AnyReader([folder / "bag"], default_typestore=autoware_types()) as reader:
        return [reader.deserialize(raw, of.msgtype) for of, _, raw in reader.messages()]


def yaw_of(pose: Any) -> float:
    return 2.0 * math.atan2(pose.orientation.z, pose.orientation.w)


def test_a_velocity_is_told_in_the_objects_own_frame(tmp_path: Path) -> None:
    """A car that looks north slides north-east: ahead, and to the right."""
    (message,) = objects_of(tmp_path, replace(one_car(), velocity=np.array([[3.0, 4.0]])))
    kinematics = message.objects[0].kinematics
    assert yaw_of(kinematics.initial_pose_with_covariance.pose) == pytest.approx(math.pi / 2)
    twist = kinematics.initial_twist_with_covariance
    assert (twist.twist.linear.x, twist.twist.linear.y) == pytest.approx((4.0, -3.0))
    assert not twist.covariance.any()  # zeros: not known
    assert not kinematics.initial_pose_with_covariance.covariance.any()


@pytest.mark.parametrize("ahead", [1.0, -1.0])
def test_a_car_that_reverses_looks_where_it_looked(tmp_path: Path, ahead: float) -> None:
    """North, or backwards; not round by 180 degrees at the first step."""
    still = one_car()
    steps = np.arange(1, still.trajectories.shape[2] + 1)
    path = np.broadcast_to(still.position[:, None, None], still.trajectories.shape).copy()
    path[..., 1] += ahead * 0.2 * steps
    (message,) = objects_of(tmp_path, replace(still, trajectories=path))
    poses = message.objects[0].kinematics.predicted_paths[0].path
    assert ahead * (poses[-1].position.y - poses[0].position.y) > 5.0
    assert [math.sin(yaw_of(pose)) for pose in poses] == pytest.approx([1.0] * len(poses))


def test_a_velocity_that_is_not_known_can_be_told_from_standing(tmp_path: Path) -> None:
    """Both are 0, and only one of them is said to be measured; so are headings."""
    stands = replace(one_car(), velocity=np.zeros((1, 2)))
    unknown = replace(one_car(), velocity=np.full((1, 2), np.nan), heading_rad=np.array([np.nan]))
    told = [one.objects[0].kinematics for one in objects_of(tmp_path, stands, unknown)]
    twists = [kinematics.initial_twist_with_covariance for kinematics in told]
    assert [(t.twist.linear.x, t.twist.linear.y) for t in twists] == [(0.0, 0.0)] * 2
    diagonals = [t.covariance.reshape(6, 6).diagonal() for t in twists]
    np.testing.assert_array_equal(diagonals, [[0.0] * 6, [10_000.0] * 6])
    yaws = [k.initial_pose_with_covariance.covariance[35] for k in told]
    assert yaws == [0.0, 10_000.0]
    for kinematics in told:  # which nobody measures
        accel = kinematics.initial_acceleration_with_covariance.covariance.reshape(6, 6)
        np.testing.assert_array_equal(accel, 10_000.0 * np.eye(6))
        assert len(kinematics.predicted_paths) == 2  # planners take the best without looking


@pytest.mark.parametrize(
    ("kind", "label"),
    [
        (ObjectClass.UNKNOWN, 0),
        (ObjectClass.CAR, 1),
        (ObjectClass.TRUCK, 2),
        (ObjectClass.MOTORCYCLE, 5),
        (ObjectClass.BICYCLE, 6),
        (ObjectClass.PEDESTRIAN, 7),
        (ObjectClass.ANIMAL, 8),
        (ObjectClass.STATIC, 0),
        (99, 0),
    ],
)
def test_classes_are_autowares(tmp_path: Path, kind: int, label: int) -> None:
    """Also one that this version does not know."""
    car = replace(one_car(), object_class=np.array([kind], np.uint8))
    (message,) = objects_of(tmp_path, car)
    (said,) = message.objects[0].classification
    assert (said.label, said.probability) == (label, 1.0)


def test_silence_is_stamped_with_when_it_was_said(tmp_path: Path) -> None:
    """Not with the last measurement: then, there were objects. In Foxglove they go."""
    car = one_car()
    silent = replace(nobody(), cycle=301, made_s=car.made_s + 0.4)
    before, after = objects_of(tmp_path, car, silent)
    assert (len(before.objects), len(after.objects)) == (1, 0)
    stamps = [m.header.stamp.sec + 1e-9 * m.header.stamp.nanosec for m in (before, after)]
    assert stamps[1] - stamps[0] == pytest.approx(0.012, abs=0.01)  # recorded at once
    convert(read_recordings(tmp_path)[0], "foxglove", tmp_path / "drive.mcap")
    with (tmp_path / "drive.mcap").open("rb") as stream:
        scenes = [
            SceneUpdate.FromString(message.data)
            for _, _, message in mcap.reader.make_reader(stream).iter_messages(topics=["/scene"])
        ]
    shown, gone = scenes[0].entities[0].timestamp, scenes[1].deletions[0].timestamp
    assert gone.ToNanoseconds() > shown.ToNanoseconds()


def test_without_a_map_pose_no_object_is_in_autowares_map(tmp_path: Path) -> None:
    messages = objects_of(tmp_path, one_car(), replace(one_car(), mode=Mode.NO_POSE))
    assert [message.header.frame_id for message in messages] == ["map", "odom"]


def test_a_path_is_moved_on_to_the_time_of_the_message() -> None:
    """38 ms at 10 m/s are 0.38 m; of 30 steps, 29 are left."""
    path = moved_on(one_car(), 0, 0)
    assert len(path) == 30
    np.testing.assert_allclose(path[:, 0], 100.0)
    np.testing.assert_allclose(path[:, 1], 220.38 + np.arange(30), atol=1e-9)
    car = one_car()
    now = replace(car, anchor_s=np.array([car.timestamp_s]))
    np.testing.assert_allclose(moved_on(now, 0, 0)[1:], now.trajectories[0, 0])


def test_a_bag_is_not_written_over(
    recording: Recording, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["convert", str(recording.paths[0]), "--to", "rosbag2", "--out", str(tmp_path)]
    assert main(command) == 2
    assert "a new folder" in capsys.readouterr().err


def test_of_a_bag_that_cannot_be_written_nothing_stays(
    recording: Recording, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Half a bag would be in the way of the next attempt."""
    bag = tmp_path / "bag"
    command = ["convert", str(recording.paths[0]), "--to", "rosbag2", "--out", str(bag)]
    with files_of_at_most(1 << 12):
        assert main(command) == 1
    assert capsys.readouterr().err.startswith(f"eqrt: cannot write {bag} (")
    assert not bag.exists()


@pytest.mark.parametrize("out", ["-", "out.jsonl"])
def test_what_is_missing_of_a_recording_is_said(
    recording: Recording, tmp_path: Path, capsys: pytest.CaptureFixture[str], out: str
) -> None:
    """Also where its predictions go to standard output, and not among them."""
    torn = tmp_path / recording.paths[0].name
    torn.write_bytes(recording.paths[0].read_bytes()[:-1000])
    file = out if out == "-" else str(tmp_path / out)
    assert main(["convert", str(torn), "--to", "jsonl", "--out", file]) == 0
    told = capsys.readouterr()
    assert told.err.count("\n") == 1
    assert "read up to there" in told.err
    assert "read up to there" not in told.out


# --- text


def test_candump_text_is_the_log_again(recording: Recording, tmp_path: Path) -> None:
    convert(recording, "candump", tmp_path / "drive.log")
    played = first_seconds(NGSIM.log, 2.0).splitlines()
    written = (tmp_path / "drive.log").read_text().splitlines()
    assert [line.split()[:3] for line in written] == [line.split()[:3] for line in played]


@pytest.mark.parametrize(
    "line",
    [
        "(1.000000) can0 123#R8 R\n",
        "(1.000000) can1 384##1112233 T\n",
        "(1.000000) can0 18DAF110#0211 R\n",
        "(1.000000) can0 20000080#0000000000000000 R\n",
        "(1.000000) can0 7FF# R\n",
    ],
)
def test_every_kind_of_message_has_its_line(line: str) -> None:
    assert candump_line(candump_message(line)) == line


def test_json_lines_are_those_of_replay(recording: Recording, tmp_path: Path) -> None:
    convert(recording, "jsonl", tmp_path / "out.jsonl")
    expected = b"".join(map(json_lines, recording.forecasts()))
    assert (tmp_path / "out.jsonl").read_bytes() == expected


def test_times_are_told_by_the_wall_clock() -> None:
    """A target measured 50 ms before its prediction was finished, 2 ms before it was recorded."""
    car: ForecastSet = one_car()
    moment = Moment(5_000_000_000, car, {})
    assert moment.wall_ns(float(car.anchor_s[0])) == pytest.approx(4_950_000_000, abs=1000)
