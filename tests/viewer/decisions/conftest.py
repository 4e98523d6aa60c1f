"""Decisions with made-up candidates, with and without images."""

from __future__ import annotations

import shutil

import pytest
from recorded_candidates import write_recorded_candidates
from synthetic import RayCaster, write_trajectory

from robocas_ms3.datasets.candidate_images.render import render_candidates
from robocas_ms3.datasets.candidate_images.settings import CandidateImageSettings
from robocas_ms3.viewer.decisions.decision_source import DecisionSource


@pytest.fixture(scope="session")
def plain_file(tmp_path_factory):
    """Two episodes with a decision of each kind, without images."""
    folder = tmp_path_factory.mktemp("candidates")
    trajectory = write_trajectory(folder / "trajectory.h5", seeds=(3, 4))
    return write_recorded_candidates(folder / "candidates.h5", trajectory, steps=(0, 6, 12, 18))


@pytest.fixture(scope="session")
def file_with_images(plain_file, tmp_path_factory):
    path = shutil.copy(plain_file, tmp_path_factory.mktemp("images") / "candidates.h5")
    render_candidates(CandidateImageSettings(path, open_renderer=RayCaster))
    return path


@pytest.fixture(scope="session")
def plain(plain_file):
    return DecisionSource(plain_file)


@pytest.fixture(scope="session")
def source(file_with_images):
    return DecisionSource(file_with_images)
