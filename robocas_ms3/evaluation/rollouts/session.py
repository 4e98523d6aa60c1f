"""Sessions that run the episodes of a protocol, with a policy or for an external loop that chooses the actions."""

from __future__ import annotations

import logging
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import replace
from functools import cache, partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from robocas_ms3.assets.pack import load_pack
from robocas_ms3.core.errors import EvaluationError, VectorEnvCrashError
from robocas_ms3.core.source_hash import hash_source
from robocas_ms3.core.workers import Limits
from robocas_ms3.datasets.conversion.env_renderer import require_renderer
from robocas_ms3.evaluation.policy import (
    CONVENTIONS,
    EpisodeSpec,
    Observations,
    Policy,
    as_action_chunks,
    describe_policy,
    forbid_policy_exit,
)
from robocas_ms3.evaluation.protocols.protocol import ProtocolEpisode, load_protocol
from robocas_ms3.evaluation.results.outcomes import EvaluatedEpisode, Outcome
from robocas_ms3.evaluation.results.result_files import append_episode, open_result
from robocas_ms3.evaluation.results.run_record import RunRecord, describe_machine, get_package_versions
from robocas_ms3.evaluation.results.stored_episodes import hash_actions
from robocas_ms3.evaluation.rollouts.action_wrapper import (
    MOTION_STEPS,
    V0_CONTROL_HZ,
    PolicyActionWrapper,
    check_action_noise_available,
    make_env_kwargs,
)
from robocas_ms3.evaluation.rollouts.rollout import (
    NOT_FINITE,
    CameraObservations,
    EndConditions,
    EpisodeBatch,
    Rollout,
    run_rollouts,
)
from robocas_ms3.evaluation.rollouts.weld import check_weld_available
from robocas_ms3.evaluation.settings import EvaluationSettings
from robocas_ms3.scenes.config import TaskConfig, load_task_config
from robocas_ms3.scenes.layout_table import FrozenLayouts
from robocas_ms3.scenes.task_specs import TASKS
from robocas_ms3.tasks.vector import choose_backend, make_vec

MAX_STARTS = 2
"""Number of starts of an episode or environment whose worker process crashes."""
_NO_EPISODE = -1
_log = logging.getLogger(__name__)


class EvaluationSession:
    """Session that runs episodes of a protocol, several at a time. Call `close` at the end.

    - `run` runs the selected episodes with the policy and writes a result.
    - `run_episodes` runs given episodes with the policy and writes no files.
    - `reset` and `step` run one episode per env for an external loop that chooses the actions.

    Steps, end conditions and metrics are equal in all three cases. The environment stays open until an episode needs
    another configuration.

    Args:
        policy: policy that chooses the actions, or an `ExternalPolicy` for an external loop.
        settings: protocol, episodes, number of envs, backend and output folder.
        wrap_env: function that gets each new vector environment and returns the environment to use.

    Attributes:
        episodes: the selected episodes of the protocol.
        played_as: tasks that are evaluated in the episodes of another task (`LoadedProtocol.find_task_aliases`).
        rate: control steps per second. A policy step is one control step; with RoboCAS-v0's steps it is 1 to 7 control
            steps at 5 Hz (`PolicyActionWrapper`).
        evaluated: by index of the env, the episode that has ended since the last `reset`.

    Raises:
        EvaluationError: the protocol does not exist, the policy or the weld does not fit it, no episode is selected,
            or the object pack differs from the pack of the protocol.
        DatasetError: the policy uses cameras and there is no render device.
    """

    def __init__(
        self, policy: Policy, settings: EvaluationSettings, wrap_env: Callable[[Any], Any] = lambda env: env
    ) -> None:
        self.policy, self.settings, self._wrap_env = policy, settings, wrap_env
        self.protocol, self.spec = load_protocol(settings.protocol), policy.spec
        rules = self.protocol.rules
        rules.check_policy(self.spec)
        self.rate = V0_CONTROL_HZ if rules.stepping == "upstream" else rules.choose_action_rate(self.spec)
        backend = choose_backend(settings.backend)
        if settings.weld:
            check_weld_available(rules.stepping, backend)
        if any(settings.action_noise):
            check_action_noise_available(self.spec)
        self.played_as = self.protocol.find_task_aliases(settings.tasks)
        self.episodes = self.protocol.select_episodes(settings)
        if self.spec.cameras:
            self.protocol.check_cameras(self.spec, self.episodes)
            require_renderer()
        if (check_robot := getattr(self.policy, "check_robot", None)) is not None:
            check_robot(rules.robot)
        self._log_policy_warnings()
        self.run_record = self._make_run_record(backend)
        self.folder = settings.choose_folder(rules.name, self.played_as)
        self.evaluated: dict[int, EvaluatedEpisode] = {}
        objects = load_pack(rules.pack, usage=False).objects
        self._layouts_of = cache(lambda config: FrozenLayouts(self.protocol.layouts_file(config), objects))
        self._refill = backend != "gpu"
        self._env: Any = None
        self._batch: EpisodeBatch | None = None
        self._open_for: tuple[str, int, int] | None = None  # configuration, number of envs and step limit of `_batch`
        self._current: list[ProtocolEpisode] = []  # episodes of an external loop, by env
        self._observed = 0.0  # clock time at which the external loop received the last observation, s

    def run(self, on_start: Callable[[int], None] = lambda count: None) -> Iterator[Outcome]:
        """Run the selected episodes that the result does not have yet; write and yield the outcome of each.

        The result also gets the executed actions and the checkpoints of each episode (`stored_episodes`).

        ``on_start`` is called with the number of episodes to run.

        Raises:
            OutputExistsError: the existing result has other settings.
            RobocasError: another process writes to the folder, or the folder was removed.
        """
        settings = self.settings
        opened = open_result(
            self.folder, self.run_record, overwrite=settings.overwrite, retry_errors=settings.retry_errors
        )
        with closing(self), opened as done:
            missing = [episode for episode in self.episodes if episode.episode not in done]
            on_start(len(missing))
            for evaluated in self.run_episodes(missing):
                append_episode(self.folder, evaluated)
                yield evaluated.outcome

    def max_steps(self, task: str) -> int:
        """Return the maximum number of policy steps per episode of a task, by the rules of the protocol."""
        steps = self.protocol.rules.step_limit(task, self.rate)
        assert steps is not None  # `load_protocol` checks it
        return steps

    def make_episode_spec(self, episode: ProtocolEpisode) -> EpisodeSpec:
        """Return the specification of an episode for `Policy.reset`, with ``env`` -1: no env runs it yet."""
        return EpisodeSpec(
            env=-1,
            episode=episode.episode,
            task=episode.task,
            config_file=str(self.protocol.config_file(episode.config)),
            layouts_file=str(self.protocol.layouts_file(episode.config)),
            pack=self.protocol.rules.pack,
            seed=episode.seed,
            instruction=episode.instruction,
            robot=self.protocol.rules.robot,
            max_steps=self.max_steps(episode.task),
            motion_steps=MOTION_STEPS[self.protocol.rules.stepping],
        )

    def run_episodes(
        self, episodes: Sequence[ProtocolEpisode], max_steps: int | None = None
    ) -> Iterator[EvaluatedEpisode]:
        """Run episodes with the policy, one configuration after another; yield outcome and actions of each at its end.

        ``max_steps``: maximum number of policy steps per episode; None: the maximum of the protocol.

        Raises:
            VectorEnvCrashError: a worker process crashed twice while it ran no episode.
        """
        try:
            for config in dict.fromkeys(episode.config for episode in episodes):
                yield from self._run_configuration([one for one in episodes if one.config == config], max_steps)
        except BaseException:
            self.close()
            raise

    def reset(self, numbers: Sequence[int]) -> Observations:
        """Start an episode in each env and return the first observations; running episodes are dropped.

        ``numbers``: numbers of the episodes in the protocol, one per env, with equal configurations.

        Raises:
            EvaluationError: an episode does not exist, the number of episodes is not the number of envs, or the
                episodes have different configurations.
        """
        where, known, count = self.protocol.rules.name, self.protocol.episodes, self.settings.envs
        for number in numbers:
            if not 0 <= number < len(known):
                raise EvaluationError(
                    "unknown episode number", where=where, expected=f"0 to {len(known) - 1}", found=number
                )
        if len(numbers) != count:
            raise EvaluationError(
                "wrong number of episodes", where=where, expected=f"{count}, one per env", found=len(numbers)
            )
        episodes = [known[number] for number in numbers]
        self.protocol.check_same_configuration(episodes)
        self._current, self.evaluated = episodes, {}
        batch = self.open_batch(episodes[0], count)
        try:
            batch.start_episodes([(env, self.make_episode_spec(episode)) for env, episode in enumerate(episodes)])
        except Exception:
            self.close()
            raise
        return self._observe(batch)

    def step(self, actions: ArrayLike) -> Observations | None:
        """Execute actions (N, A), or all H actions of chunks (N, H, A), in the running episodes.

        Rows of envs whose episode has ended have no effect. A NaN or infinite action ends its episode with an error.
        Returns the observations of the envs whose episode is running; None if all episodes have ended.

        Raises:
            EvaluationError: no episode is running, or the actions have another shape.
            VectorEnvCrashError: a worker process of the environment crashed.
        """
        batch = self._batch
        if batch is None or not batch.running:
            raise EvaluationError("no episode is running", fix="Call reset before step.")
        chunks = as_action_chunks(actions, batch.num_envs, batch.action_size, where="step")
        seconds = (time.perf_counter() - self._observed) / len(batch.running)
        for env, running in batch.running.items():
            running.inference_seconds += seconds
            if not np.isfinite(chunks[env]).all():
                running.error = NOT_FINITE
        try:
            for step in range(chunks.shape[1]):
                active = [env for env, running in batch.running.items() if not running.error]
                rows = np.zeros((batch.num_envs, batch.action_size), np.float32)
                rows[active] = chunks[active, step]
                for ended in batch.step(rows):
                    self.evaluated[ended.spec.env] = self._make_episode(ended, self._current[ended.spec.env])
                if not batch.running:
                    return None
        except Exception:
            self.close()
            raise
        return self._observe(batch)

    @property
    def outcomes(self) -> dict[int, Outcome]:
        """Return the outcomes of the episodes that have ended since the last `reset`, by index of the env."""
        return {env: one.outcome for env, one in self.evaluated.items()}

    @property
    def observation(self) -> dict[str, Any]:
        """Return the last observation of the vector environment: a nested dict of arrays (N, ...), without images."""
        assert self._batch is not None
        return self._batch.obs

    def observe_cameras(self, envs: Sequence[int]) -> CameraObservations:
        """Return the present observations of the cameras of the policy in E envs, whose episodes may have ended."""
        assert self._batch is not None
        return self._batch.observe_cameras(np.array(envs))

    def open_batch(self, episode: ProtocolEpisode, num_envs: int, max_steps: int | None = None) -> EpisodeBatch:
        """Return the open batch of envs if it fits, or open one.

        It fits if it has the configuration of the episode, the number of envs and the maximum number of policy steps
        (None: the maximum of the protocol).
        """
        steps = self.max_steps(episode.task) if max_steps is None else max_steps
        key, rules = (episode.config, num_envs, steps), self.protocol.rules
        if self._batch is not None and self._open_for == key:
            return self._batch
        if self._open_for is None or self._open_for[:2] != key[:2]:
            self.close()
            self._env = self._wrap_env(self._make_env(episode, num_envs))
        ends = EndConditions(steps, tuple(rules.ends_on), rules.max_v0_steps)
        self._batch = EpisodeBatch(self._env, self.spec, ends, 1 / self.rate, refill=self._refill)
        self._open_for = key
        return self._batch

    def close(self) -> None:
        """Close the vector environment. The next episode opens a new one."""
        env, self._env, self._batch, self._open_for = self._env, None, None, None
        if env is not None:
            env.close()

    def _run_configuration(self, episodes: list[ProtocolEpisode], max_steps: int | None) -> Iterator[EvaluatedEpisode]:
        left, crashes = {episode.episode: episode for episode in episodes}, Counter[int]()
        while left:
            batch = None
            try:
                batch = self.open_batch(episodes[0], min(self.settings.envs, len(left)), max_steps)
                for ended in run_rollouts(
                    batch, self.policy, [self.make_episode_spec(episode) for episode in left.values()]
                ):
                    yield self._make_episode(ended, left.pop(ended.spec.episode))
            except VectorEnvCrashError as error:
                self.close()
                lost = (
                    []
                    if batch is None
                    else list(batch.fail_crashed(error.envs, f"the worker process crashed: {error.found}"))
                )
                crashes.update([ended.spec.episode for ended in lost] or [_NO_EPISODE])
                if crashes[_NO_EPISODE] == MAX_STARTS:
                    raise
                if not lost:
                    _log.warning(
                        "a worker process crashed while no episode was running; restarting the environments: %s", error
                    )
                for ended in lost:
                    number = ended.spec.episode
                    if crashes[number] < MAX_STARTS:
                        _log.warning("episode %d: %s; the episode is repeated once", number, ended.error)
                    else:
                        yield self._make_episode(ended, left.pop(number))

    def _log_policy_warnings(self) -> None:
        """Log the warnings that ``policy.protocol_warnings`` returns for the configurations of the episodes."""
        warn: Callable[[dict[str, TaskConfig]], list[str]] | None = getattr(self.policy, "protocol_warnings", None)
        if warn is None:
            return
        with forbid_policy_exit(self.policy):
            for warning in warn(self._load_configs(self.episodes)):
                _log.warning("%s", warning)

    def _list_training_differences(self) -> dict[str, list[str]] | None:
        """Return by configuration of the protocol what the training data of the policy lacks; None: unknown."""
        find: Callable[[dict[str, TaskConfig]], dict[str, list[str]] | None] | None
        find = getattr(self.policy, "list_training_differences", None)
        if find is None:
            return None
        with forbid_policy_exit(self.policy):
            return find(self._load_configs(self.protocol.episodes))

    def _load_configs(self, episodes: Sequence[ProtocolEpisode]) -> dict[str, TaskConfig]:
        """Load the configurations of episodes by name, with the evaluated task."""
        configs: dict[str, TaskConfig] = {}
        for name, task in dict.fromkeys((episode.config, self._find_task(episode)) for episode in episodes):
            config = load_task_config(self.protocol.config_file(name))
            configs[name] = config if config.task == task else config.model_copy(update={"task": task})
        return configs

    def _observe(self, batch: EpisodeBatch) -> Observations:
        observations = batch.observe(sorted(batch.running))
        self._observed = time.perf_counter()
        return observations

    def _make_episode(self, ended: Rollout, episode: ProtocolEpisode) -> EvaluatedEpisode:
        layouts = self._layouts_of(episode.config)
        outcome = ended.make_outcome(episode, layouts(episode.seed, episode.seed).object_ids)
        actions = np.array(ended.actions, np.float32).reshape(-1, CONVENTIONS[self.spec.convention].size)
        outcome = replace(outcome, task=self._find_task(episode), actions_hash=hash_actions(actions))
        return EvaluatedEpisode(outcome, actions, ended.stack_checkpoints())

    def _find_task(self, episode: ProtocolEpisode) -> str:
        """Return the task that is evaluated in an episode."""
        return next((task for task, other in self.played_as.items() if other == episode.task), episode.task)

    def _make_env(self, episode: ProtocolEpisode, num_envs: int) -> Any:
        rules, settings = self.protocol.rules, self.settings
        changes = {"weld": settings.weld, "action_noise": settings.action_noise, "checkpoints": self._refill}
        stepping = partial(PolicyActionWrapper, spec=self.spec, stepping=rules.stepping, **changes)
        render: dict[str, Any] = {}
        if settings.render_size is not None:
            width, height = settings.render_size
            render = {"render_mode": "rgb_array", "human_render_camera_configs": {"width": width, "height": height}}
        return make_vec(
            TASKS[episode.task].env_id,
            num_envs,
            arrays="numpy",
            auto_reset=False,
            ignore_terminations=True,
            record_metrics=False,
            wrappers=[stepping],
            backend=settings.backend,
            workers=settings.workers,
            limits=Limits(settings.step_seconds, settings.memory_gb),
            config=str(self.protocol.config_file(episode.config)),
            layouts=str(self.protocol.layouts_file(episode.config)),
            pack=rules.pack,
            robot_uids=rules.robot,
            **make_env_kwargs(self.spec, self.rate, renders=bool(render)),
            **render,
        )

    def _make_run_record(self, backend: str) -> RunRecord:
        rules, name = self.protocol.rules, self.settings.policy
        self.protocol.check_pack()
        differences = self._list_training_differences()
        values = {
            "protocol": rules.name,
            "protocol_hash": self.protocol.hash,
            "policy": {"name": name} | describe_policy(self.policy) | {"name": name},  # a description may not rename it
            "weld": self.settings.weld,
            **({"action_noise": self.settings.action_noise} if any(self.settings.action_noise) else {}),
            **({"played_as": self.played_as} if self.played_as else {}),
            **({"training_differences": differences} if differences is not None else {}),
            "backend": backend,
            "versions": get_package_versions(),
            "source_hash": hash_source(),
            "pack_hashes": {rules.pack: rules.pack_hash},
            "machine": describe_machine(),
        }
        return RunRecord.from_values(values, f"policy {name}")
