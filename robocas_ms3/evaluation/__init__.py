"""Evaluation of policies: frozen protocols, sessions, results, statistics and reports.

`protocols` has the frozen episodes, `rollouts` runs them, `results` has their outcomes, `report` shows them, `audit`
replays them. `policy` is the interface of policies; `policies` are chosen by name. `remote` connects to a policy behind
a socket, `harness` to the evaluation loops of other packages. Public names are imported from this package at first use.
"""

from typing import TYPE_CHECKING

from robocas_ms3.core.lazy import make_lazy_exports

if TYPE_CHECKING:
    from robocas_ms3.evaluation.policies import make_policy as make_policy
    from robocas_ms3.evaluation.policies import open_policy as open_policy
    from robocas_ms3.evaluation.policy import EpisodeSpec as EpisodeSpec
    from robocas_ms3.evaluation.policy import Observations as Observations
    from robocas_ms3.evaluation.policy import Policy as Policy
    from robocas_ms3.evaluation.policy import PolicySpec as PolicySpec
    from robocas_ms3.evaluation.protocols.protocol import LoadedProtocol as LoadedProtocol
    from robocas_ms3.evaluation.protocols.protocol import load_protocol as load_protocol
    from robocas_ms3.evaluation.remote.client import RemotePolicy as RemotePolicy
    from robocas_ms3.evaluation.remote.server import PolicyServer as PolicyServer
    from robocas_ms3.evaluation.report import write_report as write_report
    from robocas_ms3.evaluation.results.outcomes import Outcome as Outcome
    from robocas_ms3.evaluation.results.result_files import Result as Result
    from robocas_ms3.evaluation.results.result_files import read_result as read_result
    from robocas_ms3.evaluation.rollouts.session import EvaluationSession as EvaluationSession
    from robocas_ms3.evaluation.settings import EvaluationSettings as EvaluationSettings

__getattr__, __dir__, __all__ = make_lazy_exports(
    __name__,
    {
        "robocas_ms3.evaluation.results.outcomes": ["Outcome"],
        "robocas_ms3.evaluation.policies": ["make_policy", "open_policy"],
        "robocas_ms3.evaluation.policy": ["EpisodeSpec", "Observations", "Policy", "PolicySpec"],
        "robocas_ms3.evaluation.protocols.protocol": ["LoadedProtocol", "load_protocol"],
        "robocas_ms3.evaluation.remote.client": ["RemotePolicy"],
        "robocas_ms3.evaluation.remote.server": ["PolicyServer"],
        "robocas_ms3.evaluation.report": ["write_report"],
        "robocas_ms3.evaluation.results.result_files": ["Result", "read_result"],
        "robocas_ms3.evaluation.rollouts.session": ["EvaluationSession"],
        "robocas_ms3.evaluation.settings": ["EvaluationSettings"],
    },
)
