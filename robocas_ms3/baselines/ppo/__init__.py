"""`ppo`: learns by trying, from dense rewards and what only a simulator knows. No demonstrations."""

from __future__ import annotations

from typing import Any

from robocas_ms3.baselines.ppo.agent import Agent
from robocas_ms3.baselines.ppo.config import PpoConfig
from robocas_ms3.baselines.ppo.policy import PpoPolicy
from robocas_ms3.baselines.ppo.training import PpoTraining
from robocas_ms3.baselines.ppo.trials import EnvTrials


class Ppo:
    """See `TrialBaseline`."""

    name, version = "ppo", 1
    about = "learns by trying, from dense rewards and what only a simulator knows; no data"
    Config = PpoConfig
    trials = EnvTrials
    training = PpoTraining

    def model(self, config: PpoConfig, facts: dict[str, Any]) -> Agent:
        """Policy and value."""
        return Agent(facts["observed"], facts["acted"], config.width)

    def policy(self, config: PpoConfig, facts: dict[str, Any], model: Agent) -> PpoPolicy:
        """What acts by it, without noise."""
        return PpoPolicy(facts, model)


BASELINE = Ppo()
