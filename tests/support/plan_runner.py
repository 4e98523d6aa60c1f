"""Run the synthetic plan into a folder: python plan_runner.py OUT [EXECUTOR [OPTION=VALUE ...]]."""

if __name__ == "__main__":
    import sys
    from pathlib import Path

    from plan_stages import PLAN, stub_stages

    from robocas_ms3.plans.executors import open_executor
    from robocas_ms3.plans.folder import PlanFolder
    from robocas_ms3.plans.run import run_plan

    out, name, *options = [*sys.argv[1:], *(["local"] if len(sys.argv) == 2 else [])]
    with stub_stages():
        folder = PlanFolder(PLAN, Path(out))
        run_plan(open_executor(name, folder, 2, dict(option.split("=", 1) for option in options)))
