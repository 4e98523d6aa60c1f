"""Plays episodes of a protocol, a batch at a time, for a process at the other end of a channel, which acts in them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, ValidationError

from robocas_ms3 import __version__
from robocas_ms3.datasets.writing.render import require_renderer
from robocas_ms3.errors import EvaluationError, WireError
from robocas_ms3.evaluation import results
from robocas_ms3.evaluation.actions import CONVENTIONS
from robocas_ms3.evaluation.bridge.actor import AbandonedBatch, Actor, ObservationKeeper
from robocas_ms3.evaluation.bridge.channel import Channel
from robocas_ms3.evaluation.bridge.proprioception import WIDTHS
from robocas_ms3.evaluation.outcomes import Outcome
from robocas_ms3.evaluation.policy import Reference, Wants
from robocas_ms3.evaluation.protocol import Episode, load_protocol
from robocas_ms3.evaluation.rollout import Rollouts, Rules
from robocas_ms3.evaluation.run import Settings, about, chosen
from robocas_ms3.evaluation.stage import make_env, object_ids, rate_of, start_of
from robocas_ms3.strict import StrictModel, refusal
from robocas_ms3.tasks.vector.backend import Backend, choose_backend

VERSION = 1
"""Of the messages: another one is refused."""
_Pixels = Annotated[int, Field(ge=1, le=4096)]


class BridgeRequest(StrictModel):
    """The first message: what is to be played.

    Attributes:
        version: of the messages.
        protocol: name of a shipped one, or folder.
        task: short name; its episodes alone.
        split: its episodes of this split alone; empty: of all.
        num_envs: episodes of a batch.
        convention, reference, rate_hz, cameras: of `Wants`; a camera's size as [width, height].
        backend: where envs run, see `make_vec`.
        results: folder to write a result into; None: none is written.
        name: of the policy, in that result.
    """

    version: int
    protocol: str
    task: str
    num_envs: Annotated[int, Field(ge=1, le=4096)]
    convention: str
    reference: Reference
    rate_hz: int
    cameras: Annotated[dict[str, Annotated[list[_Pixels], Field(min_length=2, max_length=2)]], Field(min_length=1)]
    split: str = ""
    backend: Backend = "auto"
    results: str | None = None
    name: str = "bridge"


class TasksRequest(StrictModel):
    """Another first message: which tasks there are.

    Attributes:
        version: of the messages.
        tasks_of: name of a shipped protocol, or folder.
        split: the tasks of this split's episodes alone; empty: of all.
    """

    version: int
    tasks_of: str
    split: str = ""


class TaskList:
    """Says which tasks a protocol has; nothing is played.

    Args:
        asked: the first message.
        channel: it came by.

    Raises:
        EvaluationError: there is no such protocol, or split.
    """

    def __init__(self, asked: TasksRequest, channel: Channel) -> None:
        self._channel = channel
        episodes = chosen(load_protocol(asked.tasks_of).episodes, Settings(split=asked.split))
        self._tasks = list(dict.fromkeys(episode.task for episode in episodes))

    def ready(self) -> dict[str, Any]:
        """The tasks, in the protocol's order."""
        return {"tasks": self._tasks}

    def run(self) -> None:
        """Wait until the other end is closed.

        Raises:
            EOFError: it is.
            EvaluationError: it asked for more.
        """
        message = self._channel.receive()
        raise EvaluationError("nothing is played here", found=str(message)[:200])

    def close(self) -> None:
        """Nothing is open."""


class Bridge:
    """Plays what it was asked for, in batches of as many episodes as there are envs.

    An episode is played, and what comes of it is found, by the loop that ``robocas eval`` has.

    Args:
        asked: the first message.
        channel: it came by.

    Raises:
        EvaluationError: it can't be played.
        DatasetError: there is no render device.
    """

    def __init__(self, asked: BridgeRequest, channel: Channel) -> None:
        self._channel, self._count, self._backend = channel, asked.num_envs, asked.backend
        cameras = {name: (size[0], size[1]) for name, size in asked.cameras.items()}
        self.wants = Wants(asked.convention, asked.reference, asked.rate_hz, cameras)
        self._protocol = load_protocol(asked.protocol)
        self._protocol.rules.refuse(self.wants)
        settings = Settings(asked.num_envs, asked.backend, tasks=(asked.task,), split=asked.split)
        self._episodes = chosen(self._protocol.episodes, settings)
        configs = list(dict.fromkeys(episode.config for episode in self._episodes))
        if asked.num_envs > 1 and len(configs) > 1:  # a batch has one
            splits = ", ".join(dict.fromkeys(episode.split for episode in self._episodes))
            fix = f"Choose one of the splits {splits}; or play one episode at a time."
            raise EvaluationError(
                "several configurations", where=asked.protocol, expected="one", found=", ".join(configs), fix=fix
            )
        require_renderer()
        self._rate = rate_of(self._protocol, self.wants)
        steps = self._protocol.rules.steps(asked.task, self._rate)
        assert steps is not None  # `load_protocol` saw to it
        rules = self._protocol.rules
        self._ends = Rules(steps, tuple(rules.ends_on), rules.max_v0_steps)
        self._actor = Actor(channel, self.wants, asked.num_envs)
        run = about(self._protocol, self._actor, asked.name, settings)
        self._results = None if asked.results is None else Path(asked.results)
        self._kept: set[int] = set()  # episodes of the result
        if self._results is not None:
            if (self._results / results.OUTCOMES).exists():
                raise EvaluationError("there is a result already", where=self._results, fix="Choose another folder.")
            results.begin(self._results, run, resume=False)
        self._env: ObservationKeeper | None = None
        self._config = ""

    def ready(self) -> dict[str, Any]:
        """What the other end is told before the first batch."""
        return {
            "episodes": len(self._episodes),
            "max_steps": self._ends.max_steps,
            "rate_hz": self._rate,
            "action_size": CONVENTIONS[self.wants.convention].size,
            "widths": WIDTHS,
            "protocol": self._protocol.rules.name,
            "protocol_hash": self._protocol.hash,
            "robocas_ms3": __version__,
        }

    def run(self) -> None:
        """Play batches, until the other end is closed.

        Raises:
            EOFError: it is.
            EvaluationError: it asked for what there is not.
        """
        message = self._channel.receive()
        while True:
            try:
                self._play(self._asked_for(message))
                message = self._channel.receive()
            except AbandonedBatch as abandoned:
                message = abandoned.message

    def close(self) -> None:
        """Close the envs."""
        if self._env is not None:
            self._env.close()
        self._env = None

    def _asked_for(self, message: dict[str, Any]) -> list[Episode]:
        numbers = message.get("play")
        known = range(len(self._episodes))
        if (
            not isinstance(numbers, list)
            or len(numbers) != self._count
            or any(type(one) is not int or one not in known for one in numbers)
        ):
            expected = f"{self._count} numbers of episodes below {len(known)} to play"
            raise WireError("no batch", expected=expected, found=str(message)[:200])
        return [self._episodes[number] for number in numbers]

    def _play(self, episodes: list[Episode]) -> None:
        env, actor = self._env_of(episodes[0]), self._actor
        actor.begin(env)
        refill = choose_backend(self._backend) != "gpu"  # resets as `robocas eval` does there
        rollouts = Rollouts(env, actor, self._ends, 1 / self._rate, refill=refill)
        for played in rollouts.play([start_of(self._protocol, episode) for episode in episodes]):
            one = episodes[played.start.env]
            outcome = Outcome.of(played, one, object_ids(self._protocol, one))
            actor.ended[played.start.env] = outcome
            if self._results is not None and one.episode not in self._kept:
                results.append(self._results, outcome)
                self._kept.add(one.episode)
        actor.report()

    def _env_of(self, episode: Episode) -> ObservationKeeper:
        if self._env is None or self._config != episode.config:
            self.close()
            made = make_env(self._protocol, self.wants, episode, self._count, backend=self._backend)
            self._env, self._config = ObservationKeeper(made), episode.config
        return self._env


def open_bridge(channel: Channel) -> Bridge | TaskList:
    """Read the first message, and make what it asks for.

    Raises:
        EvaluationError: it is none, or asks for what there is not.
        DatasetError: there is no render device.
    """
    message = channel.receive()
    if message.get("version") != VERSION:
        raise EvaluationError(
            "another version of the messages",
            where="robocas_ms3",
            expected=VERSION,
            found=message.get("version"),
            fix="Install robocas-ms3 and lerobot_env_robocas of one release.",
        )
    form = TasksRequest if "tasks_of" in message else BridgeRequest
    try:
        asked = form.model_validate(message)
    except ValidationError as error:
        raise refusal(error, form, EvaluationError, where="", about="can't play that") from error
    return TaskList(asked, channel) if isinstance(asked, TasksRequest) else Bridge(asked, channel)
