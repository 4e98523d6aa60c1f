"""`ppo`: reinforcement learning from dense rewards and privileged state, without demonstrations."""

from __future__ import annotations

from typing import Any

from robocas_ms3.baselines.ppo.agent import Agent, PpoPolicy
from robocas_ms3.baselines.ppo.config import PpoConfig
from robocas_ms3.baselines.ppo.environments import PpoEnvironments
from robocas_ms3.baselines.ppo.train import train_ppo
from robocas_ms3.baselines.training.run_folder import RunFolder


class Ppo:
    """See `RLBaseline`."""

    name, version = "ppo", 1
    about = "reinforcement learning from dense rewards and privileged state; no data"
    Config = PpoConfig

    def environments(self, config: PpoConfig, device: str) -> PpoEnvironments:
        """Create the environments on ``cpu`` or ``cuda``."""
        return PpoEnvironments(config, device)

    def model(self, config: PpoConfig, facts: dict[str, Any]) -> Agent:
        """Build the networks of policy and value."""
        return Agent(facts["observed"], facts["acted"], config.width)

    def train(self, run: RunFolder, model: Agent, config: PpoConfig, environments: PpoEnvironments) -> None:
        """Train until all steps are done."""
        train_ppo(run, model, config, environments)

    def policy(self, config: PpoConfig, facts: dict[str, Any], model: Agent) -> PpoPolicy:
        """Return the policy, which acts without noise."""
        return PpoPolicy(facts, model)


BASELINE = Ppo()
