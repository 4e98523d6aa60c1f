"""Folders of questions: ``questions.jsonl``, ``questions.json`` with the settings of the scenes, and images.

A set of questions is such a folder without images, like those in the package. `render_questions` renders its images.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter, ValidationError

from robocas_ms3.core.documents import load_json
from robocas_ms3.core.errors import EvaluationError
from robocas_ms3.core.files import atomic_file, make_folder
from robocas_ms3.core.json_lines import JsonLinesFile
from robocas_ms3.core.output_folder import FolderKind, OutputFolder
from robocas_ms3.core.paths import removal_questions_dir
from robocas_ms3.core.strict_model import error_from_validation
from robocas_ms3.core.text import did_you_mean
from robocas_ms3.core.workers import WorkerPool, use_one_torch_thread
from robocas_ms3.datasets.images.png import encode_png
from robocas_ms3.demos.difficulty.difficulty_file import DifficultySettings, read_difficulties, read_settings
from robocas_ms3.demos.difficulty.records import SceneDifficulty
from robocas_ms3.demos.recordings.trajectory_json import package_versions
from robocas_ms3.evaluation.removal_questions.records import RemovalQuestion

if TYPE_CHECKING:
    from robocas_ms3.evaluation.removal_questions.question_renderer import QuestionRenderer

OUTPUT = FolderKind("robocas questions", ("questions.json",), "scenes")
QUESTIONS = "questions.jsonl"
Scenes = dict[str, DifficultySettings]
"""Settings of the scenes of questions, by the part of their ids before the seed."""
_SCENES: TypeAdapter[Scenes] = TypeAdapter(Scenes)
_CHECKED = "checked.jsonl"  # ids of the rendered scenes, with or without a question


@dataclass(frozen=True)
class QuestionSet:
    """Questions, and the settings of their scenes."""

    questions: list[RemovalQuestion]
    scenes: Scenes
    folder: Path

    def find_image(self, question: RemovalQuestion) -> Path:
        """Return the path of the image of a question; raise EvaluationError if it was not rendered."""
        path = self.folder / "images" / f"{question.id}.png"
        if not path.is_file():
            fix = "Run robocas questions render."
            raise EvaluationError("the image of this question is missing", where=path, fix=fix)
        return path


def bundled_question_sets() -> dict[str, Path]:
    """Return the folders of the bundled sets of questions by name."""
    return {path.parent.name: path.parent for path in sorted(removal_questions_dir().glob(f"*/{QUESTIONS}"))}


def read_question_set(source: str | Path) -> QuestionSet:
    """Read a set of questions.

    Args:
        source: name of a bundled set, or a folder.

    Raises:
        EvaluationError: there is no such set, or a file is damaged.
    """
    bundled = bundled_question_sets()
    folder = bundled.get(str(source), Path(source))
    file = JsonLinesFile[RemovalQuestion](folder / QUESTIONS, RemovalQuestion)
    lines = file.read_lines()
    if not lines:
        expected = f"one of {', '.join(bundled)}, or a folder of robocas questions"
        fix = did_you_mean(str(source), bundled)
        raise EvaluationError("no such set of questions", where=source, expected=expected, fix=fix, usage=True)
    for line in lines:
        if line.record is None:
            raise file.make_line_error(line, EvaluationError, "damaged question")
    questions = [line.record for line in lines if line.record is not None]
    counts = Counter(question.id for question in questions)
    if repeated := [name for name, count in counts.items() if count > 1]:
        raise EvaluationError("several questions have the same id", where=file.path, found=repeated[0])
    return QuestionSet(questions, _read_scenes(folder / OUTPUT.records[0]), folder)


def make_questions(
    sources: Sequence[Path],
    out: Path,
    *,
    jobs: int = 1,
    overwrite: bool = False,
    on_scenes: Callable[[int, int], None] = lambda done, total: None,
) -> int:
    """Make questions about measured scenes, with images, and return their number.

    The same call continues an interrupted one. At the end the questions are in the order of the sources and seeds.

    Args:
        sources: output folders of ``robocas difficulty``; their names are the beginnings of the ids.
        out: output folder.
        jobs: number of processes that render, which has no effect on the questions.
        overwrite: whether to delete earlier results.
        on_scenes: called with (scenes done, all scenes); scenes without removals need no image.

    Raises:
        EvaluationError: two sources have the same name.
        ConfigError: a source is not an output folder of ``robocas difficulty``.
        DatasetError: there is no render device.
        OutputExistsError: ``out`` has other sources or versions, or was written by another command.
    """
    names = [folder.name for folder in sources]
    if len(set(names)) < len(names):
        raise EvaluationError("two folders have the same name", expected="different names", found=", ".join(names))
    scenes = {folder.name: read_settings(folder) for folder in sources}
    tasks = [
        (name, scene)
        for name, folder in zip(names, sources, strict=True)
        for scene in read_difficulties(folder)
        if scene.removals
    ]
    places = {f"{name}-{scene.seed}": place for place, (name, scene) in enumerate(tasks)}
    record = _make_record(scenes)
    with OutputFolder(out, OUTPUT, record, overwrite=overwrite) as output:
        _require_renderer()
        output.start(record)
        file = JsonLinesFile[RemovalQuestion](out / QUESTIONS, RemovalQuestion)
        checked = JsonLinesFile[str](out / _CHECKED, str)
        done = set(checked.read())
        missing = [task for task in tasks if f"{task[0]}-{task[1].seed}" not in done]
        for identifier, question in _render(scenes, missing, out, jobs, on_scenes, len(tasks)):
            output.check_exists()
            if question is not None:
                file.append([question])
            checked.append([identifier])
        questions = {question.id: question for question in file.read() if question.id in places}
        file.rewrite(sorted(questions.values(), key=lambda question: places[question.id]))
    return len(questions)


def render_questions(
    questions: QuestionSet,
    out: Path,
    *,
    jobs: int = 1,
    overwrite: bool = False,
    on_images: Callable[[int, int], None] = lambda done, total: None,
) -> None:
    """Write a set of questions with its images to a folder; the same call continues an interrupted one.

    Args:
        questions: set of questions.
        out: output folder.
        jobs: number of processes that render.
        overwrite: whether to delete earlier results.
        on_images: called with (images done, all images).

    Raises:
        EvaluationError: a scene differs from its question.
        DatasetError: there is no render device.
        OutputExistsError: ``out`` has other questions or versions, or was written by another command.
    """
    record = _make_record(questions.scenes)
    with OutputFolder(out, OUTPUT, record, overwrite=overwrite) as output:
        _require_renderer()
        output.start(record)
        missing = [
            (question.id.rpartition("-")[0], question)
            for question in questions.questions
            if not (out / "images" / f"{question.id}.png").is_file()
        ]
        for _ in _render(questions.scenes, missing, out, jobs, on_images, len(questions.questions)):
            output.check_exists()
        JsonLinesFile[RemovalQuestion](out / QUESTIONS, RemovalQuestion).rewrite(questions.questions)


_Task = tuple[str, SceneDifficulty | RemovalQuestion]


def _render(
    scenes: Scenes,
    tasks: Sequence[_Task],
    out: Path,
    jobs: int,
    on_progress: Callable[[int, int], None],
    total: int,
) -> Iterator[tuple[str, RemovalQuestion | None]]:
    """Render scenes; yield the id of each, and its question."""
    make_folder(out / "images")
    done = total - len(tasks)
    on_progress(done, total)
    processes = max(1, min(jobs, len(tasks)))
    pool: WorkerPool[_Task, tuple[str, RemovalQuestion | None]] = WorkerPool(
        partial(_QuestionWorker, scenes, out, processes), processes
    )
    with pool, closing(pool.map(tasks, ordered=False)) as results:
        for result in results:
            yield result
            done += 1
            on_progress(done, total)


class _QuestionWorker:
    """Makes or renders one question after another; the environment is made again when the configuration changes."""

    def __init__(self, scenes: Scenes, out: Path, processes: int) -> None:
        if processes > 1:  # software renderers on all cores slow each other down
            os.environ.setdefault("LP_NUM_THREADS", "1")
        use_one_torch_thread()
        self._scenes, self._images = scenes, out / "images"
        self._name, self._renderer = "", None

    def run(self, task: _Task) -> tuple[str, RemovalQuestion | None]:
        name, what = task
        renderer, identifier = self._open_renderer(name), f"{name}-{what.seed}"
        if isinstance(what, RemovalQuestion):
            self._write_image(what, renderer.render_question(what))
            return identifier, what
        made = renderer.make_question(what)
        if made is None:
            return identifier, None
        self._write_image(*made)
        return identifier, made[0]

    def _write_image(self, question: RemovalQuestion, image: NDArray[np.uint8]) -> None:
        with atomic_file(self._images / f"{question.id}.png") as path:
            path.write_bytes(encode_png(image))

    def _open_renderer(self, name: str) -> QuestionRenderer:
        from robocas_ms3.evaluation.removal_questions.question_renderer import QuestionRenderer  # takes seconds

        if self._renderer is None or name != self._name:
            self.close()
            self._name, self._renderer = name, QuestionRenderer(self._scenes[name], name)
        return self._renderer

    def close(self) -> None:
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None


def _make_record(scenes: Mapping[str, DifficultySettings]) -> dict[str, Any]:
    return {"scenes": {name: asdict(settings) for name, settings in scenes.items()}, "versions": package_versions()}


def _read_scenes(path: Path) -> Scenes:
    try:
        return _SCENES.validate_python(load_json(path)["scenes"])
    except (FileNotFoundError, LookupError, TypeError) as error:
        what = "the settings of the scenes of these questions are missing"
        raise EvaluationError(what, where=path, expected='a JSON file with the key "scenes"') from error
    except ValidationError as error:
        raise error_from_validation(error, _SCENES, EvaluationError, where=path) from error


def _require_renderer() -> None:
    from robocas_ms3.datasets.conversion.env_renderer import require_renderer  # imports the simulator

    require_renderer()
