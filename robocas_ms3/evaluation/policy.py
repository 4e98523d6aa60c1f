"""The interface of policies: what they observe, what their actions mean, and how they are asked for actions."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from functools import partial
from typing import Annotated, Any, Literal, Protocol, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import ConfigDict, Field
from scipy.spatial.transform import Rotation

from robocas_ms3.core.errors import EvaluationError
from robocas_ms3.core.files import json_text
from robocas_ms3.core.signals import forbid_exit
from robocas_ms3.robots.cameras import CAMERA_NAME
from robocas_ms3.robots.quantities import QUANTITIES
from robocas_ms3.robots.registry import DEFAULT_ROBOT

ROBOT_QUANTITIES = {quantity.policy_key: quantity for quantity in QUANTITIES if quantity.policy_key}
"""Quantities of the robot that policies observe, by their names there."""
Language = Literal["none", "text", "embedding"]
Reference = Literal["tcp", "target"]
Pixels = Annotated[int, Field(ge=1, le=4096)]
"""Width or height of an image."""
Array = NDArray[np.float64]


@dataclass(frozen=True)
class TcpMotion:
    """Relative motions of E TCPs, each in its own frame (z approach, y closing): (E, 3) m, E rotations, (E,) bool."""

    translation: Array
    rotation: Rotation
    open: NDArray[np.bool_]


@dataclass(frozen=True)
class Convention:
    """A convention of actions: numbers per action, and how actions (E, size) become motions; None: joint targets."""

    size: int
    decode: Callable[[Array], TcpMotion] | None


def _motions(rotation: Callable[[Array], Rotation], open_above: float = 0.0) -> Callable[[Array], TcpMotion]:
    def read(actions: Array) -> TcpMotion:
        return TcpMotion(actions[:, :3], rotation(actions[:, 3:-1]), actions[:, -1] > open_above)

    return read


def _quaternions(wxyz: Array) -> Rotation:
    xyzw = wxyz[:, [1, 2, 3, 0]]
    lengths = np.linalg.norm(xyzw, axis=1, keepdims=True)
    return Rotation.from_quat(np.where(lengths > 1e-9, xyzw / np.maximum(lengths, 1e-9), [0.0, 0.0, 0.0, 1.0]))


_euler = partial(Rotation.from_euler, "xyz")
# Translation in m, then rotation (Euler angles about fixed axes x, y, z in rad, a rotation vector in rad, or a
# quaternion wxyz), both in the TCP's frame; the last number is the gripper's, open above 0, of the paper's above 0.5.
CONVENTIONS: dict[str, Convention] = {
    "robocas": Convention(7, _motions(_euler, 0.5)),
    "delta_euler": Convention(7, _motions(_euler)),
    "delta_axis_angle": Convention(7, _motions(Rotation.from_rotvec)),
    "delta_quaternion": Convention(8, _motions(_quaternions)),
    "joint_positions": Convention(8, None),  # seven joint targets, rad; gripper, -1 closed to 1 open
}
"""By name."""


@dataclass(frozen=True)
class PolicySpec:
    """What a policy declares; a mismatch with the protocol is refused before the first step.

    Attributes:
        convention: meaning of its actions, one of `CONVENTIONS`.
        reference: motions are relative to where the TCP is, or to where the last action sent it.
        rate_hz: actions per second; None: the protocol's.
        cameras: (width, height) in pixels by camera; empty: no images.
        depth: whether images come with depth.
        state: whether it observes privileged state (docs/rl.md).
        language: form of the instruction.
        observe_every: number of steps between two images that it looks at, from the first step on; those in between may
            be black, as rendering is most of the cost of an evaluation. Its chunks have a multiple of this length.
    """

    __pydantic_config__ = ConfigDict(extra="forbid")  # of specifications in messages and addresses

    convention: str = "robocas"
    reference: Reference = "target"
    rate_hz: Annotated[float, Field(gt=0, allow_inf_nan=False)] | None = None
    cameras: Mapping[str, tuple[Pixels, Pixels]] = field(default_factory=dict)
    depth: bool = False
    state: bool = False
    language: Language = "text"
    observe_every: int = 1

    def __post_init__(self) -> None:
        wrong_cameras = [name for name in self.cameras if not re.fullmatch(CAMERA_NAME, name)]
        for name, fits, expected in (
            ("convention", self.convention in CONVENTIONS, f"one of {sorted(CONVENTIONS)}"),
            ("reference", self.reference in get_args(Reference), f"one of {list(get_args(Reference))}"),
            ("language", self.language in get_args(Language), f"one of {list(get_args(Language))}"),
            ("cameras", not wrong_cameras, "names like side_camera"),
            ("observe_every", self.observe_every >= 1, "1 or more"),
        ):
            if not fits:
                found = repr(wrong_cameras[0] if name == "cameras" else getattr(self, name))
                raise EvaluationError("a policy can't want that", where=name, expected=expected, found=found)


@dataclass(frozen=True)
class EpisodeSpec:
    """An episode as a policy gets to know it.

    Attributes:
        env: number of the env that runs it, as in `Observations.envs`.
        episode: its number in the protocol's list.
        task: short name.
        config_file, layouts_file: of its configuration and its scene.
        pack: name of the object pack, or its folder.
        seed: of its scene.
    """

    env: int
    episode: int
    task: str
    config_file: str
    layouts_file: str
    pack: str
    seed: int
    instruction: str
    robot: str = DEFAULT_ROBOT


@dataclass(frozen=True)
class Observations:
    """Observations of E envs, a row each; NumPy arrays.

    Attributes:
        envs: (E,) numbers of the envs.
        instructions: E texts; empty strings with language ``none``.
        embeddings: (E, 384) float32 sentence embeddings, or None.
        images: by camera (E, H, W, 3) uint8.
        depths: by camera (E, H, W, 1) int16, mm.
        robot: (E, D) by name, the quantities of `ROBOT_QUANTITIES`; they are attributes too, such as ``qpos``.
        state: (E, D) privileged state, or None.
    """

    envs: NDArray[np.int64]
    instructions: list[str]
    embeddings: NDArray[np.float32] | None
    images: dict[str, NDArray[np.uint8]]
    depths: dict[str, NDArray[Any]]
    robot: dict[str, NDArray[np.float32]]
    state: NDArray[np.float32] | None

    def __getattr__(self, name: str) -> NDArray[np.float32]:
        if name not in ROBOT_QUANTITIES:
            raise AttributeError(name)
        return self.robot[name]


def privileged_state(extra: Mapping[str, Any]) -> NDArray[np.float32]:
    """Return the privileged state (N, D) of an environment's ``obs["extra"]``, arrays (N, ...)."""
    return np.concatenate([np.asarray(value) for name, value in extra.items() if name != "tcp_pose"], axis=1)


class Policy(Protocol):
    """A policy, which runs several episodes at a time."""

    @property
    def spec(self) -> PolicySpec: ...

    def reset(self, episodes: list[EpisodeSpec]) -> None:
        """Start episodes in some envs, and forget what was kept of these envs."""
        ...

    def act(self, observations: Observations) -> NDArray[np.floating]:
        """Return actions (E, A), or chunks (E, H, A) that are executed whole before the next call for the env."""
        ...


def as_action_chunks(actions: ArrayLike, count: int, size: int | None, *, where: str = "") -> NDArray[np.float32]:
    """Return actions (E, A) or (E, H, A) of ``count`` envs as chunks (E, H, A).

    Raises:
        EvaluationError: they are no numbers, or have another shape; ``size`` None: of any A.
    """
    found = np.asarray(actions)
    chunks = found[:, None] if found.ndim == 2 else found
    fits = chunks.ndim == 3 and len(chunks) == count and chunks.shape[1] > 0 and size in (None, chunks.shape[2])
    if found.dtype.kind not in "iuf" or not fits:
        expected = f"({count}, {size or 'size'}) or ({count}, chunk, {size or 'size'}) numbers"
        what = f"{found.shape} {found.dtype}"
        raise EvaluationError("actions don't fit", where=where, expected=expected, found=what)
    return chunks.astype(np.float32)


class ExternalPolicy:
    """Stand for the policy of an external loop, which calls `EvaluationSession.reset` and `step`."""

    def __init__(self, spec: PolicySpec) -> None:
        self.spec = spec

    def reset(self, episodes: list[EpisodeSpec]) -> None:
        pass

    def act(self, observations: Observations) -> NDArray[np.floating]:
        raise EvaluationError("this policy has no actions", where="ExternalPolicy", fix="Call reset and step.")


def policy_spec_values(spec: PolicySpec) -> dict[str, Any]:
    """Return JSON values of a specification; ``observe_every`` only if it is not 1, which older readers do not know."""
    values = {**vars(spec), "cameras": {name: list(size) for name, size in spec.cameras.items()}}
    return {key: value for key, value in values.items() if key != "observe_every" or value != 1}


def describe(policy: Policy) -> dict[str, Any]:
    """Return what a result says of a policy: class, specification, and the entries of its optional ``describe()``."""
    where = f"policy {_class_name(policy)}, describe()"
    with policy_exit_guard(policy):
        spec, added = policy_spec_values(policy.spec), getattr(policy, "describe", dict)()
    if not isinstance(added, dict):
        raise EvaluationError("invalid policy description", where=where, expected="a dict", found=type(added).__name__)
    said = {"class": _class_name(policy), "spec": spec, **added}
    return json.loads(json_text(said, where, error=EvaluationError))


def policy_exit_guard(policy: Policy) -> AbstractContextManager[None]:
    """Call a policy inside: if its code tries to end the process, that is an error (`forbid_exit`)."""
    return forbid_exit(f"policy {_class_name(policy)}")


def _class_name(policy: Policy) -> str:
    return f"{type(policy).__module__}:{type(policy).__qualname__}"
