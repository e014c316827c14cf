"""The paper's seven systems, small: what the tests of networks and of their export share."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from eqrt.core.frames import Pose2
from eqrt.core.scene import Scene
from eqrt.export.vectors import named_scenes
from eqrt.training.networks.config import SceneConfig
from eqrt.training.networks.eqmotion import EqMotion, EqMotionConfig
from eqrt.training.networks.lstm import LstmBaseline, LstmConfig

SCENE = SceneConfig(
    num_agents=4,
    history_steps=20,
    num_centerlines=4,
    centerline_points=10,
    lane_choice="nearest",
    horizon_steps=30,
    num_modes=1,
    dt_s=0.1,
)
EQMOTION = EqMotionConfig(
    hidden=8,
    layers=2,
    mlp_layers=4,
    categories=2,
    map="transformer",
    frame="rotated",
    heading="one_step",
    heads=4,
    token_width=12,
    image_pixels=40,
    image_cell_m=2.5,
    image_channels=3,
    image_width=16,
)
LSTM = LstmConfig(
    hidden=8,
    mlp_layers=4,
    image_pixels=40,
    image_cell_m=2.5,
    image_channels=3,
    image_width=16,
)
SYSTEMS: dict[str, EqMotionConfig | LstmConfig] = {
    "lstm": LSTM,
    "no_map": replace(EQMOTION, map="none"),
    "translated_attention": replace(EQMOTION, map="attention", frame="translated"),
    "rotated_attention": replace(EQMOTION, map="attention"),
    "translated_transformer": replace(EQMOTION, frame="translated"),
    "rotated_transformer": EQMOTION,
    "rotated_cnn": replace(EQMOTION, map="raster"),
}
"""In the order of the paper's table."""
EQUIVARIANT = {
    **{name: SYSTEMS[name] for name in ("no_map", "rotated_attention", "rotated_transformer")},
    "rotated_cnn": SYSTEMS["rotated_cnn"],
    "robust_heading": replace(EQMOTION, heading="robust"),
}
"""Those that promise it."""
SCENES = named_scenes(SCENE.contract("test", "0.0.0"))


def small_system(config: EqMotionConfig | LstmConfig, scene: SceneConfig = SCENE) -> nn.Module:
    """A network with random weights everywhere, also where training starts from zero."""
    torch.manual_seed(7)
    model: nn.Module
    if isinstance(config, LstmConfig):
        model = LstmBaseline(scene, config)
    else:
        model = EqMotion(scene, config)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(0.1 * torch.randn_like(parameter))
    return model.eval()


def predict(model: nn.Module, scene: Scene) -> NDArray[np.float64]:
    """Trajectories (B, K, H, 2) of a network in float64."""
    inputs = [torch.from_numpy(value) for value in scene.inputs().values()]
    with torch.no_grad():
        trajectories, _ = model(*(v.double() if v.is_floating_point() else v for v in inputs))
    found: NDArray[np.float64] = trajectories.numpy()
    return found


def nan_free(scene: Scene) -> Scene:
    """0 for every NaN."""
    return replace(
        scene, history=np.nan_to_num(scene.history), centerlines=np.nan_to_num(scene.centerlines)
    )


def move_exactly(scene: Scene, pose: Pose2) -> Scene:
    """Turned and shifted in float64, so that nothing but the network can break the symmetry."""
    changes: dict[str, Any] = {
        "history": pose.apply(np.asarray(scene.history, np.float64)),
        "heading": pose.rotate(np.asarray(scene.heading, np.float64)),
        "centerlines": pose.apply(np.asarray(scene.centerlines, np.float64)),
    }
    return replace(scene, **changes)
