"""Recording on a machine with a GPU; skipped without a CUDA device. `scripts/gpu_checks.sh` runs these tests."""

import pytest
import torch
from gpu_emulation import emulated_envs

from robocas_ms3.demos.candidates.candidates_file import FILE_NAME, CandidateFile
from robocas_ms3.demos.generation import generate
from robocas_ms3.demos.settings import EpisodeSettings, GenerateSettings

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device: unproven on a GPU"),
    pytest.mark.skipif(emulated_envs() > 0, reason="the worker process does not use the emulation"),
]


def test_candidates_are_recorded_in_a_worker_process(tmp_path):
    settings = EpisodeSettings("pick", "pick_upstream_eval", record_candidates=True, candidates=3)
    generate(GenerateSettings(settings, tmp_path / "demos", episodes=1, jobs=1))  # needs processes that can be forked
    assert len(CandidateFile(tmp_path / "demos" / FILE_NAME)) > 0
