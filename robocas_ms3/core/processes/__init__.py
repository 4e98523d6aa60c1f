"""Tasks done by several processes, limits of what they may take, and errors sent between them."""

from robocas_ms3.core.exits import uninterrupted
from robocas_ms3.core.processes.child import NO_LIMITS, Limits
from robocas_ms3.core.processes.lives import is_too_large, leave_with, use_one_torch_thread
from robocas_ms3.core.processes.pool import Pool
from robocas_ms3.core.processes.sent import SentError, SentTraceback
from robocas_ms3.core.processes.worker import Calls, Worker

__all__ = [
    "NO_LIMITS",
    "Calls",
    "Limits",
    "Pool",
    "SentError",
    "SentTraceback",
    "Worker",
    "is_too_large",
    "leave_with",
    "uninterrupted",
    "use_one_torch_thread",
]
