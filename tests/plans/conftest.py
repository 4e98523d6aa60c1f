import os
import shutil

import pytest
from plan_stages import env_of_jobs, run_here, stub_stages


@pytest.fixture(autouse=True)
def replaced_stages():
    with stub_stages():
        yield


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    """A Ray cluster of two nodes on this machine."""
    pytest.importorskip("ray", reason="needs the ray extra: plans on a cluster of Ray are NOT tested")
    from ray.cluster_utils import Cluster

    before = dict(os.environ)
    os.environ |= {
        "RAY_USAGE_STATS_ENABLED": "0",
        "RAY_TMPDIR": "/tmp",  # paths of sockets are short
        "TMPDIR": f"{tmp_path_factory.mktemp('node')}",
        "PLAN_FAULTS": f"{tmp_path_factory.mktemp('faults')}",
        **env_of_jobs(),
    }
    quick = {"health_check_initial_delay_ms": 0, "health_check_period_ms": 500, "health_check_timeout_ms": 500}
    head = {"num_cpus": 1, "include_dashboard": False, "_system_config": quick | {"health_check_failure_threshold": 6}}
    cluster = Cluster(initialize_head=True, head_node_args=head)
    cluster.second = cluster.add_node(num_cpus=1)
    yield cluster
    cluster.shutdown()
    os.environ.clear()
    os.environ |= before


@pytest.fixture(scope="session")
def done(tmp_path_factory):
    out = tmp_path_factory.mktemp("done") / "out"
    with pytest.MonkeyPatch.context() as patch, pytest.raises(ZeroDivisionError):
        patch.setattr("robocas_ms3.plans.run.join_episodes", lambda *_, **__: 1 / 0)
        run_here(out)
    return out


@pytest.fixture(scope="session")
def undisturbed(done, tmp_path_factory):
    """The output of the synthetic plan without faults, for comparison; read-only."""
    out = shutil.copytree(done, tmp_path_factory.mktemp("plan") / "out")
    run_here(out)
    return out


@pytest.fixture
def out(done, tmp_path):
    """The folder of a plan whose work units are complete and not joined."""
    return shutil.copytree(done, tmp_path / "out")
