"""What ``--env.type=robocas`` may be told, and the environments that LeRobot's commands make of it."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs import EnvConfig
from lerobot.utils.constants import ACTION, OBS_IMAGES, OBS_STATE, OBS_STR

from lerobot_env_robocas.vector_env import RoboCASVectorEnv, tasks_of

ACTION_SIZES = {
    "robocas": 7,
    "delta_euler": 7,
    "delta_axis_angle": 7,
    "delta_quaternion": 8,
    "joint_positions": 8,
}
NUMBERS = {  # of observations, by their names there: width, and what a policy knows them by
    "agent_pos": (18, OBS_STATE),
    "joint_velocity": (7, f"{OBS_STR}.joint_velocity"),
    "arm_base": (7, f"{OBS_STR}.arm_base"),
    "gripper_open": (1, f"{OBS_STR}.gripper_open"),
}


@EnvConfig.register_subclass("robocas")
@dataclass
class RoboCASEnvConfig(EnvConfig):
    """RoboCAS. Defaults are those of the LeRobot datasets that robocas_ms3 writes.

    Attributes:
        task: of the protocol's, ``pick``, say; several with commas between them; ``all`` of them.
        fps: actions a second; what the policy was trained at.
        protocol: which frozen episodes are played: ``ms3-v1``, ``smoke``, ... or a folder.
        split: which of its episodes, such as ``seen`` or ``new`` of ``objects-v1``; empty: all.
        cameras: with commas between them; the first one is filmed.
        observation_width, observation_height: of every camera, pixels.
        convention, reference: what actions mean.
        python: interpreter that has robocas_ms3; default: $ROBOCAS_SIM_PYTHON, else that of the ``robocas`` command.
        backend: ``processes``, ``gpu`` or ``auto``.
        results: folder for results that ``robocas eval report`` and ``compare`` read, one a task.
        policy_name: of the policy, in those results.
        timeout_s: clock time a step or a reset may take.
    """

    task: str | None = "pick"
    fps: int = 5
    protocol: str = "ms3-v1"
    split: str = ""
    cameras: str = "base_camera,gripper_camera,static_camera"
    observation_width: int = 640
    observation_height: int = 480
    convention: str = "robocas"
    reference: str = "tcp"
    python: str | None = None
    backend: str = "auto"
    results: str | None = None
    policy_name: str = "lerobot"
    timeout_s: float = 600.0
    features: dict[str, PolicyFeature] = field(default_factory=dict)
    features_map: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.convention not in ACTION_SIZES:
            raise ValueError(f"env.convention: expected one of {', '.join(ACTION_SIZES)}, found {self.convention!r}")
        pixels = PolicyFeature(FeatureType.VISUAL, (self.observation_height, self.observation_width, 3))
        self.features = {ACTION: PolicyFeature(FeatureType.ACTION, (ACTION_SIZES[self.convention],))}
        self.features |= {name: PolicyFeature(FeatureType.STATE, (width,)) for name, (width, _) in NUMBERS.items()}
        self.features |= {f"{OBS_IMAGES}.{camera}": pixels for camera in self.camera_names}
        self.features_map = {key: NUMBERS[key][1] if key in NUMBERS else key for key in self.features}

    @property
    def camera_names(self) -> list[str]:
        """The cameras, in order."""
        return _listed(self.cameras, "env.cameras")

    @property
    def tasks(self) -> list[str]:
        """The tasks, in order; ``all`` are those that the simulating process finds in the protocol.

        Raises:
            RoboCASProcessError: it can't be asked, or there is no such protocol.
        """
        if self.task == "all":
            return tasks_of(self.protocol, self.split, python=self.python, timeout_s=self.timeout_s)
        return _listed(self.task or "", "env.task")

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """What all tasks' environments are made with."""
        size = (self.observation_width, self.observation_height)
        return {
            "protocol": self.protocol,
            "split": self.split,
            "fps": self.fps,
            "convention": self.convention,
            "reference": self.reference,
            "cameras": dict.fromkeys(self.camera_names, size),
            "python": self.python,
            "backend": self.backend,
            "name": self.policy_name,
            "timeout_s": self.timeout_s,
        }

    def create_envs(self, n_envs: int, use_async_envs: bool = False) -> dict[str, dict[int, RoboCASVectorEnv]]:
        """``{task: {0: environment}}``; each simulates in processes anyway, so that ``use_async_envs`` changes nothing.

        Raises:
            RoboCASProcessError: they can't be played.
        """
        made: dict[str, dict[int, RoboCASVectorEnv]] = {}
        try:
            for task in self.tasks:
                results = None if self.results is None else str(Path(self.results).absolute() / task)
                made[task] = {0: RoboCASVectorEnv(task, n_envs, results=results, **self.gym_kwargs)}
        except BaseException:
            for envs in made.values():
                envs[0].close()
            raise
        return made


def _listed(text: str, where: str) -> list[str]:
    found = list(dict.fromkeys(word.strip() for word in text.split(",") if word.strip()))
    if not found:
        raise ValueError(f"{where}: expected one at least, found {text!r}")
    return found
