"""A program that runs the made-up plan into a folder; its processes import none of what it needs itself."""

if __name__ == "__main__":
    import sys
    from pathlib import Path

    from plan_stages import PLAN, stages

    from robocas_ms3.plans.engines.local import LocalEngine
    from robocas_ms3.plans.run import run_plan

    run_plan(
        PLAN,
        Path(sys.argv[1]),
        lambda plan, out: LocalEngine(plan, out, 2, stages=stages()),
        jobs=1,
        resume=True,
    )
