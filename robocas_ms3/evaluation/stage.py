"""The environment that a protocol's episodes are played in, and the episodes as a policy is told of them."""

from __future__ import annotations

from functools import partial
from typing import Any

from robocas_ms3.assets.pack import load_pack
from robocas_ms3.evaluation.policy import CAMERAS, EpisodeSpec, PolicySpec
from robocas_ms3.evaluation.protocol import Episode, LoadedProtocol
from robocas_ms3.evaluation.stepping import UPSTREAM_HZ, PolicyStepping, control_mode
from robocas_ms3.scenes.frozen import FrozenLayouts
from robocas_ms3.scenes.task_specs import TASKS
from robocas_ms3.tasks.vector import make_vec

_UNSEEN = 8  # pixels a side of cameras that nobody asked for, which are rendered all the same


def rate_of(protocol: LoadedProtocol, spec: PolicySpec) -> int:
    """Control steps a second."""
    return UPSTREAM_HZ if protocol.rules.stepping == "upstream" else protocol.rules.rate(spec)


def make_env(
    protocol: LoadedProtocol, spec: PolicySpec, episode: Episode, num_envs: int, *, weld: bool = False, **kwargs: Any
) -> Any:
    """Make envs for a configuration's episodes.

    Args:
        protocol: whose rules they follow.
        spec: what the policy wants to see, and speaks.
        episode: any of that configuration.
        num_envs: how many.
        weld: whether what is lifted is welded to the hand (`weld`).
        kwargs: further ones of `make_vec`.
    """
    stepped = partial(
        PolicyStepping,
        convention=spec.convention,
        reference=spec.reference,
        stepping=protocol.rules.stepping,
        look_every=spec.look_every,
        weld=weld,
    )
    return make_vec(
        TASKS[episode.task].env_id,
        num_envs,
        arrays="numpy",
        auto_reset=False,
        ignore_terminations=True,
        record_metrics=False,
        wrappers=[stepped],
        config=str(protocol.config_file(episode.config)),
        layouts=str(protocol.layouts_file(episode.config)),
        pack=protocol.rules.pack,
        robot_uids=protocol.rules.robot,
        control_mode=control_mode(spec.convention),
        reward_mode="none",
        sim_config={"control_freq": rate_of(protocol, spec)},
        max_episode_steps=10**9,  # the protocol's rules end episodes
        **{**looks(spec, renders="render_mode" in kwargs), **kwargs},
    )


def object_ids(protocol: LoadedProtocol, episode: Episode) -> tuple[str, ...]:
    """What stands in an episode's scene, by slot."""
    layouts = FrozenLayouts(protocol.layouts_file(episode.config), load_pack(protocol.rules.pack).objects)
    return layouts(episode.seed, episode.seed).object_ids


def start_of(protocol: LoadedProtocol, episode: Episode) -> EpisodeSpec:
    """An episode as a policy is told of it; its env is not known yet."""
    return EpisodeSpec(
        env=-1,
        episode=episode.episode,
        task=episode.task,
        config_file=str(protocol.config_file(episode.config)),
        layouts_file=str(protocol.layouts_file(episode.config)),
        pack=protocol.rules.pack,
        seed=episode.seed,
        instruction=episode.instruction,
        robot=protocol.rules.robot,
    )


def looks(spec: PolicySpec, *, renders: bool = False) -> dict[str, Any]:
    """Arguments of an environment that shows what a policy wants to see, and perhaps renders for others."""
    if not spec.cameras:
        return {"obs_mode": "state_dict", **({} if renders else {"render_backend": "none"})}
    modes = ["rgb", *(["depth"] if spec.depth else []), *(["state_dict"] if spec.state else [])]
    sizes = {name: spec.cameras.get(name, (_UNSEEN, _UNSEEN)) for name in CAMERAS}
    return {
        "obs_mode": "+".join(modes),
        "sensor_configs": {name: dict(width=width, height=height) for name, (width, height) in sizes.items()},
    }
