"""`ppo`: reinforcement learning from dense rewards and privileged state, without demonstrations."""

from robocas_ms3.baselines.baseline import Baseline
from robocas_ms3.baselines.ppo.agent import PpoPolicy, make_agent
from robocas_ms3.baselines.ppo.config import PpoConfig
from robocas_ms3.baselines.ppo.environments import PpoEnvironments
from robocas_ms3.baselines.ppo.train import train_ppo

BASELINE = Baseline("ppo", 2, PpoConfig, make_agent, PpoPolicy, environments=PpoEnvironments, train=train_ppo)
