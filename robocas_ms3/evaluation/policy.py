"""Interface of policies: specification, observations, action conventions, and the `Policy` protocol."""

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
"""Quantities of the robot that policies observe, by their names in `Observations.robot`."""
Language = Literal["none", "text", "embedding"]
Reference = Literal["tcp", "target"]
Pixels = Annotated[int, Field(ge=1, le=4096)]
"""Width or height of an image."""
Array = NDArray[np.float64]


@dataclass(frozen=True)
class TcpMotion:
    """Relative motions of E TCPs in their own frames (z approach, y closing direction).

    Attributes:
        translation: (E, 3) m.
        rotation: E rotations.
        open: (E,) whether the gripper is commanded to open.
    """

    translation: Array
    rotation: Rotation
    open: NDArray[np.bool_]


@dataclass(frozen=True)
class ActionConvention:
    """An action convention.

    Attributes:
        size: numbers per action.
        decode: converts actions (E, size) to motions; None: the actions are joint targets.
    """

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
# quaternion wxyz), both in the TCP's frame. The last number commands the gripper: open above 0, in `robocas` above 0.5.
CONVENTIONS: dict[str, ActionConvention] = {
    "robocas": ActionConvention(7, _motions(_euler, 0.5)),
    "delta_euler": ActionConvention(7, _motions(_euler)),
    "delta_axis_angle": ActionConvention(7, _motions(Rotation.from_rotvec)),
    "delta_quaternion": ActionConvention(8, _motions(_quaternions)),
    "joint_positions": ActionConvention(8, None),  # seven joint targets, rad; gripper, -1 closed to 1 open
}
"""Action conventions by name."""


@dataclass(frozen=True)
class PolicySpec:
    """Specification that a policy declares.

    A policy that does not fit the protocol is refused before the first step.

    Attributes:
        convention: action convention, one of `CONVENTIONS`.
        reference: pose that motions are relative to: ``tcp`` (present TCP pose) or ``target`` (last commanded pose).
        rate_hz: actions per second; None: the protocol's rate.
        cameras: (width, height) in pixels by camera name; empty: no images.
        depth: whether the policy observes depth images.
        state: whether the policy observes privileged state (docs/rl.md).
        language: form of the instruction.
        observe_every: number of policy steps between rendered images, from the first step on. Images of other steps
            are black, which saves rendering time. Chunk lengths must be multiples of this number.
    """

    __pydantic_config__ = ConfigDict(extra="forbid")  # for specifications in messages and addresses

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
            ("cameras", not wrong_cameras, "camera names such as side_camera"),
            ("observe_every", self.observe_every >= 1, "1 or more"),
        ):
            if not fits:
                found = repr(wrong_cameras[0] if name == "cameras" else getattr(self, name))
                raise EvaluationError("invalid policy specification", where=name, expected=expected, found=found)


@dataclass(frozen=True)
class EpisodeSpec:
    """Specification of an episode, as policies receive it.

    Attributes:
        env: index of the env that runs the episode, as in `Observations.envs`.
        episode: number of the episode in the protocol.
        task: short name of the task.
        config_file: YAML file of the task configuration.
        layouts_file: NumPy file of the scene layouts.
        pack: name or folder of the object pack.
        seed: seed of the scene.
        instruction: text of the instruction.
        robot: name of the robot.
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
    """Observations of E envs as NumPy arrays with one row per env.

    Attributes:
        envs: (E,) indices of the envs.
        instructions: E texts; empty with language ``none``.
        embeddings: (E, 384) float32 sentence embeddings, or None.
        images: (E, H, W, 3) uint8 by camera.
        depths: (E, H, W, 1) int16 in mm by camera.
        robot: (E, D) by name of `ROBOT_QUANTITIES`. Each quantity is also an attribute, such as ``qpos``.
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


def concatenate_privileged_state(extra: Mapping[str, Any]) -> NDArray[np.float32]:
    """Return the privileged state (N, D) from ``obs["extra"]`` of an environment, arrays (N, ...)."""
    return np.concatenate([np.asarray(value) for name, value in extra.items() if name != "tcp_pose"], axis=1)


class Policy(Protocol):
    """A policy that runs several episodes at a time.

    Optional methods: ``describe()`` returns a dict that results record. ``protocol_warnings(configs)`` gets the task
    configurations of an evaluation by name and returns warnings, such as scenes that are not in the training data.
    ``close()`` is called at the end.
    """

    @property
    def spec(self) -> PolicySpec: ...

    def reset(self, episodes: list[EpisodeSpec]) -> None:
        """Start one episode in each of some envs and drop the state of their previous episodes."""
        ...

    def act(self, observations: Observations) -> NDArray[np.floating]:
        """Return actions (E, A) or action chunks (E, H, A).

        All H steps of a chunk are executed before the next call for the env.
        """
        ...


def as_action_chunks(actions: ArrayLike, count: int, size: int | None, *, where: str = "") -> NDArray[np.float32]:
    """Return actions (E, A) or (E, H, A) of ``count`` envs as chunks (E, H, A).

    Raises:
        EvaluationError: the actions are not numeric or have another shape; ``size`` None: any A is valid.
    """
    found = np.asarray(actions)
    chunks = found[:, None] if found.ndim == 2 else found
    fits = chunks.ndim == 3 and len(chunks) == count and chunks.shape[1] > 0 and size in (None, chunks.shape[2])
    if found.dtype.kind not in "iuf" or not fits:
        expected = f"({count}, {size or 'size'}) or ({count}, chunk, {size or 'size'}) numbers"
        what = f"{found.shape} {found.dtype}"
        raise EvaluationError("invalid shape or type of actions", where=where, expected=expected, found=what)
    return chunks.astype(np.float32)


class ExternalPolicy:
    """Placeholder policy of an external loop that calls `EvaluationSession.reset` and `step`."""

    def __init__(self, spec: PolicySpec) -> None:
        self.spec = spec

    def reset(self, episodes: list[EpisodeSpec]) -> None:
        pass

    def act(self, observations: Observations) -> NDArray[np.floating]:
        raise EvaluationError("ExternalPolicy returns no actions", fix="Call EvaluationSession.reset and step.")


def policy_spec_to_dict(spec: PolicySpec) -> dict[str, Any]:
    """Return a specification as JSON values; ``observe_every`` is left out if it is 1."""
    values = {**vars(spec), "cameras": {name: list(size) for name, size in spec.cameras.items()}}
    return {key: value for key, value in values.items() if key != "observe_every" or value != 1}


def describe_policy(policy: Policy) -> dict[str, Any]:
    """Return the description of a policy for results: class, specification and ``describe()``."""
    where = f"policy {_class_name(policy)}, describe()"
    with forbid_policy_exit(policy):
        spec, added = policy_spec_to_dict(policy.spec), getattr(policy, "describe", dict)()
    if not isinstance(added, dict):
        raise EvaluationError("invalid policy description", where=where, expected="a dict", found=type(added).__name__)
    description = {"class": _class_name(policy), "spec": spec, **added}
    return json.loads(json_text(description, where, error=EvaluationError))


def forbid_policy_exit(policy: Policy) -> AbstractContextManager[None]:
    """Return a context in which a policy that tries to end the process raises an error (`forbid_exit`)."""
    return forbid_exit(f"policy {_class_name(policy)}")


def _class_name(policy: Policy) -> str:
    return f"{type(policy).__module__}:{type(policy).__qualname__}"
