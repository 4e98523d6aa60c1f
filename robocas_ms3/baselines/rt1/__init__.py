"""`rt1`: RT-1 as the RoboCAS paper trains it (Brohan et al. 2022)."""

from robocas_ms3.baselines.baseline import Baseline
from robocas_ms3.baselines.rt1.config import RT1Config
from robocas_ms3.baselines.rt1.data import RT1Samples
from robocas_ms3.baselines.rt1.model import RT1Model
from robocas_ms3.baselines.rt1.policy import RT1Policy

BASELINE = Baseline("rt1", 1, RT1Config, RT1Model, RT1Policy, RT1Samples)
