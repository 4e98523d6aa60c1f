"""What would stop a plan after days of work, looked for before it begins."""

from __future__ import annotations

from robocas_ms3.core.errors import MissingExtraError, PlanError
from robocas_ms3.plans.plan import Plan


def check_plan(plan: Plan) -> None:
    """See that a plan can be recorded, rendered and joined here.

    Raises:
        RobocasError: a rate, a size or a pack will not do, or an extra is missing.
    """
    from robocas_ms3.demos.checks import check_arguments
    from robocas_ms3.demos.recordings.motion import sample_stride
    from robocas_ms3.plans.record import settings_of

    for number, part in enumerate(plan.parts):
        check_arguments(settings_of(plan, number), episodes=part.episodes, first_seed=part.seed, jobs=1)
    if plan.makes_datasets:
        sample_stride(plan.control_freq, plan.rate)
        if plan.embeddings:
            from robocas_ms3.scenes.language.embed import TextEmbedder

            TextEmbedder()  # says what is missing; loads nothing
        if "lerobot" in plan.formats:
            _check_lerobot(plan)
    if "statistics" in plan.stages:
        from importlib.util import find_spec

        if find_spec("matplotlib") is None:
            fix = 'In the clone: pip install -e ".[plots]", or leave the stage out.'
            raise MissingExtraError("statistics are drawn with matplotlib", fix=fix)


def _check_lerobot(plan: Plan) -> None:
    from robocas_ms3.datasets.lerobot.schema import require_extra, whole_rate

    require_extra()
    whole_rate(plan.rate)
    width, height = plan.pictures.size
    if width % 2 or height % 2:
        expected, found = "even width and height", f"{width} x {height}"
        raise PlanError("videos need even sizes", where="pictures.size", expected=expected, found=found)
