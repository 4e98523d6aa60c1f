"""Suites that hold something out: what is tested is not in the configurations to train on."""

import pytest

from robocas_ms3.evaluation.protocol import load_protocol
from robocas_ms3.scenes.config import load_task_config

SUITES = ("objects", "arrangement", "clutter", "instructions", "cameras", "looks", "furniture", "paper-words")


def suite(name):
    return load_protocol(f"{name}-v1")


def trained(name):
    """Configurations to train on, by task."""
    return {config.task: config for config in map(load_task_config, suite(name).train_files())}


def held_out_of(name):
    """(split, configuration) of what is held out."""
    protocol = suite(name)
    pairs = {(episode.split, episode.config) for episode in protocol.episodes if episode.split != "seen"}
    return [(split, load_task_config(protocol.config_file(config))) for split, config in sorted(pairs)]


@pytest.mark.parametrize("name", SUITES)
def test_what_is_seen_is_what_is_trained_on(name):
    protocol = suite(name)
    seen = {episode.config for episode in protocol.episodes if episode.split == "seen"}
    configs = [load_task_config(protocol.config_file(config)) for config in sorted(seen)]
    train = trained(name)
    assert {config.task: config for config in configs} == train
    assert len(configs) == len(protocol.train_files())
    assert {config.task for _, config in held_out_of(name)} == set(train)
