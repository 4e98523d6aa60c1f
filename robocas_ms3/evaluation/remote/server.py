"""Server of a policy over websockets, for the clients of this package and openpi's client."""

from __future__ import annotations

import asyncio
import http
import itertools
import logging
import threading
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import numpy as np
from numpy.typing import NDArray
from websockets.asyncio.server import ServerConnection, serve
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from robocas_ms3 import __version__
from robocas_ms3.core.errors import ConfigError, EvaluationError, PolicyError, RobocasError, WireError
from robocas_ms3.core.paths import builtin_packs_dir, data_dir, protocols_dir
from robocas_ms3.core.strict_model import parse
from robocas_ms3.core.text import format_error, one_line
from robocas_ms3.evaluation.policy import (
    EpisodeSpec,
    Observations,
    Policy,
    as_action_chunks,
    describe_policy,
    find_image_requests,
    forbid_policy_exit,
    get_class_name,
    policy_spec_to_dict,
)
from robocas_ms3.evaluation.remote import connection
from robocas_ms3.evaluation.remote.messages import (
    ACTIONS,
    BATCH,
    DEFAULT_BATCH,
    ENV,
    ERROR,
    EVALUATION,
    FILE_NAME_PARTS,
    REQUESTS_IMAGES,
    RESET,
    EvaluationAnswer,
    EvaluationFields,
    ServerMetadata,
    check_observations_can_be_sent,
    has_images,
    max_envs_per_request,
    parse_batch,
    parse_evaluation,
    parse_observations,
    parse_request,
    request_size_limit,
)
from robocas_ms3.evaluation.remote.wire import decode_message, encode_message
from robocas_ms3.scenes.config import TaskConfig

HEALTH = "/healthz"
MAX_CONNECTIONS = 256
_log = logging.getLogger(__name__)
_MAX_ENVS = 1024  # maximum number of envs of all clients
_IDLE = 3600.0  # s without a message until a connection is closed
_STOP_S = 5.0  # s to wait for the end of the network thread
_FAILED, _INVALID, _FULL = 1011, 1008, 1013  # close codes


@dataclass(frozen=True)
class ServedFiles:
    """Files and packs of this machine that clients may select by name. No text of a message is used as a path.

    Attributes:
        files: paths of configuration and layout files. Keys are names in messages, such as
            ``smoke/configs/pick.yaml``, and also the paths themselves, for clients on the same machine.
        packs: names of installed packs, and names or folders of further packs.
    """

    files: dict[str, str]
    packs: frozenset[str]

    @classmethod
    def collect(cls, protocols: Iterable[Path] = (), packs: Iterable[str] = ()) -> ServedFiles:
        """Return the files and packs to serve: bundled protocols, installed packs, and the given protocols and packs.

        ``protocols``: folders of protocols. ``packs``: names or folders of packs.
        """
        folders = {folder.name: folder for folder in protocols_dir().iterdir()}
        for folder in protocols:
            if folder.resolve() != folders.setdefault(folder.name, folder).resolve():
                what, fix = "two protocol folders have the same name", "Rename one of the folders."
                raise EvaluationError(what, where=folder, found=folders[folder.name], fix=fix)
        files = {}
        for pattern in ("configs/*.yaml", "layouts/*.npy"):
            for path in itertools.chain.from_iterable(folder.glob(pattern) for folder in folders.values()):
                files["/".join(path.parts[-FILE_NAME_PARTS:])] = files[str(path)] = str(path)
        installed = (builtin_packs_dir(), data_dir() / "packs")
        names = {folder.name for parent in installed if parent.is_dir() for folder in parent.iterdir()}
        return cls(files, frozenset({*names, *packs}))

    def resolve_episode(self, start: EpisodeSpec) -> EpisodeSpec:
        """Return an episode of a client with the paths on this machine.

        The path or pack is an empty text if the server does not serve it.
        """
        config, layouts = (self.files.get(name, "") for name in (start.config_file, start.layouts_file))
        pack = start.pack if start.pack in self.packs else ""
        return replace(start, config_file=config, layouts_file=layouts, pack=pack)


class PolicyServer:
    """Websocket server of a policy, which answers one request after another in the thread that calls `run`.

    The policy runs in the thread that made it, so Ctrl-C interrupts it. A second thread handles the network: it answers
    pings and the health check ``/healthz`` during inference.

    Args:
        policy: the served policy.
        host: address to listen on. There is no password: everyone who can reach the address can use the policy.
        port: port to listen on; 0: a free port.
        files: files and packs that clients may select; None: those of the bundled protocols.
        max_batch: maximum number of envs per request; reduced if the images would exceed the limit of a message.

    Raises:
        EvaluationError: the policy observes the state of the simulation.
    """

    def __init__(
        self,
        policy: Policy,
        host: str = "127.0.0.1",
        port: int = 8000,
        files: ServedFiles | None = None,
        max_batch: int = DEFAULT_BATCH,
    ) -> None:
        self._host, self._port = strip_brackets(host), port
        with forbid_policy_exit(policy):
            spec = policy.spec
        check_observations_can_be_sent(spec, f"policy {get_class_name(policy)}")
        max_batch = max_envs_per_request(spec, max_batch)
        self._max_bytes = request_size_limit(spec, max_batch)
        metadata = ServerMetadata(
            robocas_spec=policy_spec_to_dict(spec),
            robocas_policy={**describe_policy(policy), "robocas_ms3": __version__},
            robocas_max_batch=max_batch,
            robocas_answers_pings=True,
            robocas_checks_evaluations=True,
        )
        self._metadata = encode_message(metadata.model_dump(by_alias=True))
        self._handler = _RequestHandler(policy, files or ServedFiles.collect(), max_batch)
        self._calls: SimpleQueue[tuple[Future[Any], Callable[[], Any]] | None] = SimpleQueue()
        self._connections = 0

    def run(self, on_listening: Callable[[str], object] = lambda url: None) -> None:
        """Serve until `stop` is called.

        ``on_listening`` is called once with the address (``ws://host:port``) when the server accepts connections.
        """
        started: Future[tuple[str, Callable[[], object]]] = Future()
        network = threading.Thread(target=self._serve, args=(started,), name="robocas-server", daemon=True)
        network.start()
        url, end = started.result()
        try:
            on_listening(url)
            while call := self._calls.get():
                future, work = call
                if future.set_running_or_notify_cancel():  # the client is still connected
                    future.set_result(work())
        finally:
            end()
            network.join(_STOP_S)

    def stop(self) -> None:
        """Stop the server from another thread: `run` answers all received requests and returns."""
        self._calls.put(None)

    def _serve(self, started: Future[tuple[str, Callable[[], object]]]) -> None:
        try:
            asyncio.run(self._listen(started))
        except Exception as error:
            if started.done():
                _log.exception("the server's network thread failed")
            else:
                started.set_exception(error)
        finally:
            self.stop()

    async def _listen(self, started: Future[tuple[str, Callable[[], object]]]) -> None:
        loop, ended = asyncio.get_running_loop(), asyncio.Event()
        server = serve(
            self._serve_client,
            self._host,
            self._port,
            process_request=_answer_health_check,
            origins=[None],  # refuse requests from web pages in a browser on this machine
            compression=None,
            max_size=self._max_bytes,
            max_queue=1,
            ping_interval=connection.PING_INTERVAL,
            ping_timeout=connection.PING_TIMEOUT,
            close_timeout=1,
        )
        try:
            running = await server
        except (OSError, UnicodeError) as error:
            raise EvaluationError(
                "cannot listen on this address", where=_format_address(self._host, self._port), found=error
            ) from error
        async with running:
            url = f"ws://{_format_address(self._host, next(iter(running.sockets)).getsockname()[1])}"
            started.set_result((url, lambda: loop.call_soon_threadsafe(ended.set)))
            await ended.wait()

    async def _serve_client(self, client: ServerConnection) -> None:
        if self._connections >= MAX_CONNECTIONS:
            return await client.close(_FULL, "too many clients")
        self._connections += 1
        connection.enable_tcp_keepalive(client)
        envs: dict[int, int] = {}  # index of the policy by index of the client
        closed = asyncio.ensure_future(client.wait_closed())
        try:
            await client.send(self._metadata)
            while True:
                message = await asyncio.wait_for(client.recv(), _IDLE)
                reply = asyncio.wrap_future(self._submit(partial(self._make_reply, message, envs)))
                await asyncio.wait({reply, closed}, return_when=asyncio.FIRST_COMPLETED)
                if not reply.done():  # the client closed the connection
                    reply.cancel()
                    return
                answer, code = reply.result()
                await client.send(answer)
                if code:
                    return await client.close(code)
        except (ConnectionClosed, asyncio.TimeoutError):
            pass
        finally:
            closed.cancel()
            self._connections -= 1
            self._submit(partial(self._handler.release_envs, envs))

    def _submit(self, work: Callable[[], Any]) -> Future[Any]:
        future: Future[Any] = Future()
        self._calls.put((future, work))
        return future

    def _make_reply(self, message: str | bytes, envs: dict[int, int]) -> tuple[str | bytes, int]:
        """Return the reply to a message, and the websocket close code; code 0: the connection stays open."""
        try:
            value = decode_message(message, self._max_bytes) if isinstance(message, bytes) else None
            return encode_message(self._handler.answer_message(value, envs)), 0
        except WireError as error:
            _log.warning("a client sent an invalid message: %s", error)
            return format_error(error, 300), _INVALID
        except Exception as error:  # a policy may raise any exception; other clients are still served
            return _log_failure(error), _FAILED


@dataclass(frozen=True)
class _ParsedRequest:
    """Request of a client.

    Attributes:
        observations: observations of the E envs of the request.
        starts: episodes that start.
        has_images: (E,) bool, whether the request contains images of each env.
    """

    observations: Observations
    starts: list[EpisodeSpec]
    has_images: NDArray[np.bool_]


class _RequestHandler:
    """Handler that converts requests to calls of a policy, and actions to answers.

    - A batched request becomes one call of ``reset`` with all episodes that start and one call of ``act`` with all
      observations, in the order of the request. An evaluation without a server makes the same calls.
    - A single request becomes a call with one env.
    - The policy gets the env index of the client. If another client uses this index, the policy gets a free one.
    - Clients that send neither ``env_id`` nor ``reset``, such as openpi's client, have one episode per connection.
    """

    def __init__(self, policy: Policy, files: ServedFiles, max_batch: int) -> None:
        self._policy, self._files, self._max_batch = policy, files, max_batch
        with forbid_policy_exit(policy):
            self._spec = policy.spec
        self._used: set[int] = set()  # envs of the policy in use

    def answer_message(self, message: Any, envs: dict[int, int]) -> dict[str, Any]:
        """Return the answer to a request.

        ``envs``: env index of the policy by env index of the client, for this connection; new envs are added.
        """
        if not isinstance(message, dict):
            raise WireError("invalid request", expected="a msgpack map", found=type(message).__name__)
        if EVALUATION in message:
            return self._check_evaluation(parse_evaluation(message[EVALUATION]))
        if BATCH not in message:
            request = self._parse_messages([message], envs)
            return self._make_answer(self._call_policy(request)[0], request.observations.envs[0])
        request = self._parse_messages(parse_batch(message, 1, self._max_batch), envs)
        actions, reasons = self._call_policy_safely(request)
        answers = [
            {ERROR: reasons[env]} if env in reasons else self._make_answer(actions[row], env)
            for row, env in enumerate(request.observations.envs.tolist())
        ]
        return {BATCH: answers}

    def _check_evaluation(self, fields: EvaluationFields) -> dict[str, Any]:
        """Return the answer to an evaluation that a client is about to start."""
        answer = EvaluationAnswer()
        policy: Any = self._policy
        try:
            configs = {name: _parse_config(name, values) for name, values in fields.configs.items()}
        except ConfigError as error:  # such as the task of a package that is not installed here
            _log.warning("the scenes of an evaluation cannot be compared with the training data: %s", error)
            return answer.model_dump()
        with forbid_policy_exit(policy):
            try:
                if fields.robot is not None and hasattr(policy, "check_robot"):
                    policy.check_robot(fields.robot)
            except RobocasError as error:
                return {ERROR: one_line(error, 300)}
            if configs and hasattr(policy, "protocol_warnings"):
                answer.warnings = policy.protocol_warnings(configs)
            if configs and hasattr(policy, "list_training_differences"):
                answer.training_differences = policy.list_training_differences(configs)
        return answer.model_dump()

    def release_envs(self, envs: dict[int, int]) -> None:
        """Free the indices of the envs of a closed connection, so that other clients can use them."""
        self._used -= set(envs.values())

    def _parse_messages(self, messages: Sequence[dict[str, Any]], envs: dict[int, int]) -> _ParsedRequest:
        numbers, starts = [], []
        for message in messages:
            request = parse_request(message)
            number, is_new = self._assign_env(request.env_id, request.reset, envs)
            numbers.append(number)
            if is_new or request.reset:
                starts.append(self._files.resolve_episode(request.make_episode_spec(number)))
        if len(set(numbers)) < len(numbers):
            raise WireError("an env is twice in a batch", where=ENV, expected="different envs", found=sorted(numbers))
        optional = hasattr(self._policy, "requests_images")
        observations = parse_observations(messages, numbers, self._spec, images_optional=optional)
        return _ParsedRequest(observations, starts, np.array([has_images(one, self._spec) for one in messages]))

    def _assign_env(self, env: int, reset: bool | None, envs: dict[int, int]) -> tuple[int, bool]:
        """Return the env index of the policy for an env index of the client, and whether the env is new."""
        if env in envs:
            return envs[env], False
        if reset is False:
            raise WireError(
                "no episode is running", where=f"{ENV} {env}", expected=f"{RESET}: true in the first request"
            )
        if len(self._used) >= _MAX_ENVS:
            raise WireError("too many envs of all clients", expected=f"at most {_MAX_ENVS}")
        preferred = [env] if 0 <= env < _MAX_ENVS else []  # the index of the client, if it is free
        envs[env] = next(number for number in itertools.chain(preferred, itertools.count()) if number not in self._used)
        self._used.add(envs[env])
        return envs[env], True

    def _call_policy(self, request: _ParsedRequest) -> NDArray[Any]:
        """Start the episodes of a request and return the actions (E, H, A) of the policy for its observations."""
        observations = request.observations
        with forbid_policy_exit(self._policy):
            if request.starts:
                self._policy.reset(request.starts)
            self._check_images(request)
            return as_action_chunks(self._policy.act(observations), len(observations.envs), None)

    def _check_images(self, request: _ParsedRequest) -> None:
        """Make images that the policy does not request black; raise `WireError` if a requested image is missing."""
        observations = request.observations
        requested = find_image_requests(self._policy, observations.envs)
        if self._spec.cameras and (missing := observations.envs[requested & ~request.has_images]).size:
            fix = f"Send images with the first observation, and if the last answer has {REQUESTS_IMAGES}: true."
            raise WireError("the policy requests images", where=f"{ENV} {missing.tolist()}", found="no images", fix=fix)
        for images in (*observations.images.values(), *observations.depths.values()):
            images[~requested] = 0

    def _make_answer(self, actions: NDArray[Any], env: int) -> dict[str, Any]:
        """Return the answer for one env; ``env``: index of the policy."""
        requested = find_image_requests(self._policy, np.array([env]))
        return {ACTIONS: actions, REQUESTS_IMAGES: bool(requested[0])}

    def _call_policy_safely(self, request: _ParsedRequest) -> tuple[Any, dict[int, str]]:
        """Return the actions (E, H, A) of the policy, or None, and the errors by index of the env.

        If the policy raises an exception, its text is the error of all envs.
        """
        observations, reasons = request.observations, dict[int, str]()
        try:
            return self._call_policy(request), {}
        except PolicyError as failed:
            text = _log_failure(failed)
            reasons = {env: one_line(reason, 300) for env, reason in failed.reasons.items()}
            if failed.actions is not None:
                return as_action_chunks(failed.actions, len(observations.envs), None), reasons
        except Exception as error:  # a policy may raise any exception; other clients are still served
            text = _log_failure(error)
        return None, {env: reasons.get(env, text) for env in observations.envs.tolist()}


def _parse_config(name: str, values: dict[str, Any]) -> TaskConfig:
    return parse(TaskConfig, values, ConfigError, where=name, about="invalid task configuration")


def strip_brackets(host: str) -> str:
    """Return a host without brackets: ``[::1]`` becomes ``::1``."""
    return host[1:-1] if host.startswith("[") and host.endswith("]") else host


def _format_address(host: str, port: int) -> str:
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


def _log_failure(error: Exception) -> str:
    """Log an error of a policy, with a traceback unless it is a `RobocasError`; return the error as one line."""
    _log.warning("the policy failed: %s", error, exc_info=None if isinstance(error, RobocasError) else error)
    return format_error(error, 300)


def _answer_health_check(client: ServerConnection, request: Request) -> Response | None:
    return client.respond(http.HTTPStatus.OK, "OK\n") if request.path == HEALTH else None
