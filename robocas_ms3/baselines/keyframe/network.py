"""Networks of `keyframe`: segmentation of images, instructions, and success of grasps."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn
from torch.nn import functional as F

from robocas_ms3.baselines.baseline import Batch
from robocas_ms3.baselines.keyframe.config import KeyframeConfig
from robocas_ms3.baselines.keyframe.gripper_crops import CROP_CHANNELS, POSE_FEATURES
from robocas_ms3.scenes.language.embed import DIMENSIONS
from robocas_ms3.scenes.relations import RELATIONS

BACKGROUND, BASKET, ROBOT, HANDLE, FIRST_NAME = range(5)
"""Classes of the cells of an image: other surfaces, the basket, the robot, the handle of a door or drawer, and
the first object name."""
STRIDE = 4
"""Pixels per cell, horizontally and vertically."""
OFFSET_UNIT = 0.05
"""m, unit of predicted offsets."""
PULL_UNIT = 0.25
"""m, unit of predicted pulls."""
_OFFSETS, _PULLS = 3, 9  # channels
_INPUT_CHANNELS = 5
_DROPPED = 0.1  # fraction of hidden values that dropout sets to 0


def make_inputs(
    rgb: NDArray[np.uint8], depth: NDArray[Any], intrinsics: NDArray[Any], camera_in_base: NDArray[Any]
) -> NDArray[np.float32]:
    """Return the inputs (5, H, W) of the segmentation network: RGB, height in the arm's base frame, and depth.

    Args:
        rgb: (H, W, 3) RGB image.
        depth: (H, W) depth along the optical axis, mm; 0: no measurement.
        intrinsics: (3, 3) intrinsic matrix, pixels.
        camera_in_base: (4, 4) pose of the OpenCV camera frame in the arm's base frame.
    """
    meters = depth.astype(np.float32) / 1000
    height, width = meters.shape
    intrinsics = intrinsics.astype(np.float32)
    u = (np.arange(width, dtype=np.float32) + 0.5 - intrinsics[0, 2]) / intrinsics[0, 0]
    v = (np.arange(height, dtype=np.float32) + 0.5 - intrinsics[1, 2]) / intrinsics[1, 1]
    up = camera_in_base[2].astype(np.float32)
    heights = (up[0] * u[None] + up[1] * v[:, None] + up[2]) * meters + up[3]
    heights = np.where(meters > 0, heights, np.float32(-0.5))
    colors = rgb.transpose(2, 0, 1).astype(np.float32) / 127.5 - 1
    return np.concatenate([colors, 3 * np.clip(heights, -0.6, 1)[None], np.clip(meters, 0, 3)[None] - 0.5])


def _convolution(inputs: int, outputs: int, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False), nn.BatchNorm2d(outputs), nn.ReLU(inplace=True)
    )


class _ResidualBlock(nn.Module):
    def __init__(self, inputs: int, outputs: int, stride: int = 1) -> None:
        super().__init__()
        self.first = _convolution(inputs, outputs, stride)
        self.second = nn.Sequential(nn.Conv2d(outputs, outputs, 3, 1, 1, bias=False), nn.BatchNorm2d(outputs))
        same = inputs == outputs and stride == 1
        self.shortcut = (
            nn.Identity()
            if same
            else nn.Sequential(nn.Conv2d(inputs, outputs, 1, stride, bias=False), nn.BatchNorm2d(outputs))
        )

    def forward(self, inputs: torch.Tensor) -> torch.Tensor:
        return F.relu(self.second(self.first(inputs)) + self.shortcut(inputs))


class SegmentationNetwork(nn.Module):
    """U-Net that classifies the cells of an RGB-D image, points to the centres of objects, and predicts pulls.

    The classes are background, basket, robot, handle, and the names of the objects.

    Args:
        channels: channels at 1/2, 1/4, 1/8, 1/16 and 1/32 of the image size.
        decoder_channels: channels of the last feature maps, at 1/4 of the image size.
        classes: number of classes.
    """

    def __init__(self, channels: tuple[int, ...], decoder_channels: int, classes: int) -> None:
        super().__init__()
        half, quarter, eighth, sixteenth, last = channels
        self.stem = _convolution(_INPUT_CHANNELS, half, 2)
        self.quarter = _ResidualBlock(half, quarter, 2)
        self.eighth = _ResidualBlock(quarter, eighth, 2)
        self.sixteenth = nn.Sequential(_ResidualBlock(eighth, sixteenth, 2), _ResidualBlock(sixteenth, sixteenth))
        self.last = nn.Sequential(_ResidualBlock(sixteenth, last, 2), _ResidualBlock(last, last))
        self.up_sixteenth = _convolution(last + sixteenth, sixteenth)
        self.up_eighth = _convolution(sixteenth + eighth, eighth)
        self.up_quarter = _convolution(eighth + quarter, decoder_channels)
        self.output = nn.Conv2d(decoder_channels, classes + _OFFSETS + _PULLS, 1)

    def forward(self, images: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return logits, offsets and pulls of the cells of images (B, 5, H, W); H and W are multiples of 32.

        Returns:
            Logits (B, classes, H / 4, W / 4). Offsets (B, 3, H / 4, W / 4) from the surface in each cell to the centre
            of its object, or to the grasp of its handle, in units of `OFFSET_UNIT`. Pulls (B, 9, H / 4, W / 4) of
            the handle: motion in units of `PULL_UNIT`, approach, and axis of the bar. All vectors are in the OpenCV
            camera frame.
        """
        quarter = self.quarter(self.stem(images))
        eighth = self.eighth(quarter)
        sixteenth = self.sixteenth(eighth)
        features = self.up_sixteenth(_upsample_and_join(self.last(sixteenth), sixteenth))
        features = self.up_eighth(_upsample_and_join(features, eighth))
        output = self.output(self.up_quarter(_upsample_and_join(features, quarter)))
        logits, offsets, pulls = output.split([output.shape[1] - _OFFSETS - _PULLS, _OFFSETS, _PULLS], dim=1)
        return logits, offsets, pulls


def _upsample_and_join(small: torch.Tensor, large: torch.Tensor) -> torch.Tensor:
    size = large.shape[-2:]
    return torch.cat([F.interpolate(small, size=size, mode="bilinear", align_corners=False), large], dim=1)


class InstructionNetwork(nn.Module):
    """MLP that predicts the name of the target and the relation from the sentence embedding of an instruction.

    names: number of object names.
    """

    def __init__(self, names: int) -> None:
        super().__init__()
        self.hidden = nn.Sequential(nn.Linear(DIMENSIONS, 256), nn.ReLU(), nn.Dropout(_DROPPED))
        self.name = nn.Linear(256, names)
        self.relation = nn.Linear(256, 1 + len(RELATIONS))

    def forward(self, embeddings: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return logits of the names (B, names), and of no relation and the relations (B, 1 + R).

        embeddings: (B, 384) sentence embeddings.
        """
        hidden = self.hidden(embeddings)
        return self.name(hidden), self.relation(hidden)


class GraspNetwork(nn.Module):
    """CNN that predicts the success of a grasp from a crop of the point cloud in the TCP frame.

    channels: channels at the four resolutions.
    """

    def __init__(self, channels: tuple[int, ...]) -> None:
        super().__init__()
        first, second, third, last = channels
        self.crop = nn.Sequential(
            _convolution(CROP_CHANNELS, first),
            _ResidualBlock(first, second, 2),
            _ResidualBlock(second, third, 2),
            _ResidualBlock(third, last, 2),
        )
        self.pose = nn.Sequential(nn.Linear(POSE_FEATURES, 32), nn.ReLU())
        self.output = nn.Sequential(nn.Linear(2 * last + 32, 96), nn.ReLU(), nn.Dropout(0.2), nn.Linear(96, 1))

    def forward(self, crops: torch.Tensor, poses: torch.Tensor) -> torch.Tensor:
        """Return the logits (B,) of success for crops (B, 3, N, N) and pose features (B, 8) (`gripper_crops`)."""
        features = self.crop(crops)
        return self.output(torch.cat([features.mean((2, 3)), features.amax((2, 3)), self.pose(poses)], dim=1))[:, 0]


class KeyframeNetwork(nn.Module):
    """Networks of `keyframe`.

    facts: facts of the data; ``names`` are the names of the objects.
    """

    def __init__(self, config: KeyframeConfig, facts: dict[str, Any]) -> None:
        super().__init__()
        names = len(facts["names"])
        self.config = config
        self.segmentation = SegmentationNetwork(config.channels, config.decoder_channels, FIRST_NAME + names)
        self.instruction = InstructionNetwork(names)
        self.grasp = GraspNetwork(config.grasp_channels)

    def forward(self, batch: Batch) -> dict[str, torch.Tensor]:
        """Return the loss and the metrics of a batch.

        Args:
            batch: ``image`` (B, 5, H, W), ``label`` (B, H / 4, W / 4) class and ``offset`` (B, 3, H / 4, W / 4) of each
                cell, ``pull`` (B, 9) of the handle in the image, ``text`` (B, T, 384), ``name`` and ``relation``
                (B, T) classes of the texts, ``crop`` (B, G, 3, N, N) and ``pose`` (B, G, 8) of grasps, ``outcome``
                (B, G) 1: success, 0: failure, -1: padding.

        Returns:
            ``loss`` and its terms ``segmentation``, ``offset``, ``pull``, ``text``, ``grasp``; ``cells``, the accuracy
            of the cells with objects and handles; ``names`` and ``grasps``, the accuracy of instructions and grasps.
        """
        logits, offsets, pulls = self.segmentation(batch["image"].contiguous(memory_format=torch.channels_last))
        logits, label = logits.float(), batch["label"]
        is_object, is_handle = label >= HANDLE, label == HANDLE
        distance = (offsets.float() - batch["offset"]).abs().sum(dim=1)
        offset = torch.stack([(distance * is_object).sum(), is_object.sum()])
        distance = _compute_pull_errors(pulls.float(), batch["pull"][:, :, None, None])
        pull = torch.stack([(distance * is_handle).sum(), is_handle.sum()])
        weights = torch.where(is_handle, 4.0, torch.where(is_object, 1.5, 0.5))
        segmentation = (F.cross_entropy(logits, label, reduction="none") * weights).sum() / weights.sum()
        names, relations = self.instruction(batch["text"].flatten(0, 1))
        text = F.cross_entropy(names.float(), batch["name"].flatten())
        text = text + F.cross_entropy(relations.float(), batch["relation"].flatten())
        known = batch["outcome"] >= 0
        outcome = batch["outcome"][known]
        # without padding, which would change the statistics of the norms
        success = self.grasp(batch["crop"][known], batch["pose"][known]).float() if len(outcome) else outcome
        errors = F.binary_cross_entropy_with_logits(success, 0.02 + 0.96 * outcome, reduction="none")
        grasp, count = errors.sum(), torch.as_tensor(len(outcome), device=outcome.device)
        config, offset_loss = self.config, offset[0] / offset[1].clamp(min=1)
        losses = segmentation + config.offset_weight * offset_loss + config.text_weight * text
        losses = losses + config.pull_weight * pull[0] / pull[1].clamp(min=1)
        with torch.no_grad():
            cells = torch.stack([((logits.argmax(1) == label) & is_object).sum(), is_object.sum()])
            grasps = torch.stack([((success > 0) == (outcome > 0.5)).sum(), count])
        return {
            "loss": losses + config.grasp_weight * grasp / max(len(outcome), 1),
            "segmentation": segmentation,
            "offset": offset,
            "pull": pull,
            "text": text,
            "grasp": torch.stack([grasp, count]),
            "cells": cells.float(),
            "names": (names.argmax(1) == batch["name"].flatten()).float().mean(),
            "grasps": grasps.float(),
        }


def _compute_pull_errors(pulls: torch.Tensor, labels: torch.Tensor) -> torch.Tensor:
    """Return the absolute errors (B, h, w) of pulls (B, 9, h, w), summed; both directions of the bar are correct."""
    errors = (pulls - labels).abs()
    other_way = (pulls[:, 6:] + labels[:, 6:]).abs()
    return errors[:, :6].sum(dim=1) + torch.minimum(errors[:, 6:].sum(dim=1), other_way.sum(dim=1))
