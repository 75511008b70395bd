"""Incremental writer of a LeRobot dataset, version 3.0."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from tableverse_factory.delivery.episodes.frames import Feature, build_frame_table, number_columns
from tableverse_factory.delivery.episodes.lerobot_card import make_lerobot_card
from tableverse_factory.delivery.episodes.render_workers import IMAGES, RenderedEpisode, RenderSetting
from tableverse_factory.delivery.episodes.statistics import FeatureStats, compute_vector_stats, merge_stats
from tableverse_factory.delivery.episodes.video import VideoFile, VideoKind, find_kind

VERSION = "v3.0"
CHUNK_FILES = 1000
DATA_MB, VIDEO_MB = 100, 200  # maximum file sizes of data/ and videos/; a single larger episode stays whole
_CHUNK_PATH = "chunk-{chunk_index:03d}/file-{file_index:03d}"
DATA_PATH = f"data/{_CHUNK_PATH}.parquet"
VIDEO_PATH = f"videos/{{video_key}}/{_CHUNK_PATH}.mp4"
EPISODES_PATH = f"meta/episodes/{_CHUNK_PATH}.parquet"
_NO_STATS = frozenset({"next.done", "next.success", "subtask"})
_MB = 1024**2


class LeRobotFiles:
    """Dataset that grows by episodes; `finish` completes it."""

    def __init__(
        self,
        folder: Path,
        setting: RenderSetting,
        features: Mapping[str, Feature],
        data_mb: float = DATA_MB,
        video_mb: float = VIDEO_MB,
    ) -> None:
        """Create the folder; the sizes are maxima per file [MB]."""
        self._folder, self._setting, self._features = folder, setting, dict(features)
        self._data_mb, self._video_mb = data_mb, video_mb
        self._tasks: dict[str, int] = {}
        self._rows: list[dict[str, Any]] = []
        self._figures: dict[str, list[FeatureStats]] = {}
        self._data: list[pa.Table] = []
        self._data_number = 0
        self._videos: dict[str, tuple[int, VideoFile]] = {}
        self.n_frames = 0
        folder.mkdir(parents=True)

    @property
    def n_episodes(self) -> int:
        """Number of episodes added."""
        return len(self._rows)

    def add(self, instruction: str, shot: RenderedEpisode, origin: Mapping[str, Any]) -> None:
        """Add an episode; `origin` are more columns of its row in meta/episodes."""
        task = self._tasks.setdefault(instruction, len(self._tasks))
        values = number_columns(shot.values, self.n_episodes, self.n_frames, task)
        count = len(values["index"])
        row: dict[str, Any] = {"episode_index": self.n_episodes, "tasks": [instruction], "length": count}
        row |= self._add_data(build_frame_table(values, self._features), count)
        for key, video in shot.videos.items():
            row |= self._add_video(key, video, count)
        figures = {name: compute_vector_stats(values[name]) for name in self._features if name not in _NO_STATS}
        for name, figure in {**shot.figures, **figures}.items():
            self._figures.setdefault(name, []).append(figure)
            row |= {f"stats/{name}/{key}": value.tolist() for key, value in figure.items()}
        self._rows.append({**row, **origin})
        self.n_frames += count

    def _add_data(self, table: pa.Table, count: int) -> dict[str, Any]:
        if self._data and sum(part.nbytes for part in self._data) + table.nbytes >= self._data_mb * _MB:
            self._write_data()
        self._data.append(table)
        chunk, file = divmod(self._data_number, CHUNK_FILES)
        return {
            "data/chunk_index": chunk,
            "data/file_index": file,
            "dataset_from_index": self.n_frames,
            "dataset_to_index": self.n_frames + count,
        }

    def _write_data(self) -> None:
        _write_parquet(self._folder / _format_path(DATA_PATH, self._data_number), self._data)
        self._data, self._data_number = [], self._data_number + 1

    def _add_video(self, key: str, video: bytes, count: int) -> dict[str, Any]:
        number, file = self._videos.get(key, (-1, None))
        if file is None or file.n_bytes + len(video) >= self._video_mb * _MB:
            if file is not None:
                file.close()
            number += 1
            path = self._folder / _format_path(VIDEO_PATH, number, video_key=key)
            path.parent.mkdir(parents=True, exist_ok=True)
            file = VideoFile(path, self._setting.fps)
            self._videos[key] = (number, file)
        start = file.n_frames
        file.add(video)
        return {
            f"videos/{key}/chunk_index": number // CHUNK_FILES,
            f"videos/{key}/file_index": number % CHUNK_FILES,
            f"videos/{key}/from_timestamp": start / self._setting.fps,
            f"videos/{key}/to_timestamp": (start + count) / self._setting.fps,
        }

    def close(self) -> None:
        """Close open videos; may be repeated."""
        for _, file in self._videos.values():
            file.close()
        self._videos = {}

    def finish(self) -> Path:
        """Write remaining data and meta/; return the folder."""
        self.close()
        self._write_data()
        rows = [{**row, "meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0} for row in self._rows]
        table = pa.Table.from_pylist(rows)
        texts = table.schema.get_field_index("paraphrases")  # without any, Arrow does not know what they are lists of
        table = table.set_column(texts, "paraphrases", table["paraphrases"].cast(pa.list_(pa.string())))
        _write_parquet(self._folder / _format_path(EPISODES_PATH, 0), [table])
        _write_parquet(self._folder / "meta/tasks.parquet", [build_tasks_table(self._tasks)])
        merged = {name: merge_stats(figures) for name, figures in self._figures.items()}
        stats = {name: {key: value.tolist() for key, value in figure.items()} for name, figure in merged.items()}
        self._write_json("meta/stats.json", stats)
        self._write_json("meta/info.json", self._info())
        card = make_lerobot_card(self._setting.kind.robot, self.n_frames, self._rows)
        (self._folder / "README.md").write_text(card, encoding="utf-8")
        return self._folder

    def _info(self) -> dict[str, Any]:
        return {
            "codebase_version": VERSION,
            "robot_type": self._setting.kind.robot,
            "total_episodes": self.n_episodes,
            "total_frames": self.n_frames,
            "total_tasks": len(self._tasks),
            "chunks_size": CHUNK_FILES,
            "data_files_size_in_mb": self._data_mb,
            "video_files_size_in_mb": self._video_mb,
            "fps": self._setting.fps,
            "splits": self._find_split_ranges(),
            "data_path": DATA_PATH,
            "video_path": VIDEO_PATH,
            "features": {
                **{IMAGES + name: self._video_feature(find_kind(name)) for name in self._setting.pictures},
                **{name: feature.as_json() for name, feature in self._features.items()},
            },
        }

    def _find_split_ranges(self) -> dict[str, str]:
        """Find the episodes of each split, which follow one another."""
        splits = [str(row["split"]) for row in self._rows]
        starts = {name: splits.index(name) for name in dict.fromkeys(splits)}
        return {name: f"{start}:{start + splits.count(name)}" for name, start in starts.items()}

    def _video_feature(self, kind: VideoKind) -> dict[str, Any]:
        height, width = self._setting.height, self._setting.width
        info = {
            "video.height": height,
            "video.width": width,
            "video.codec": kind.codec,
            "video.pix_fmt": kind.pixels,
            "video.fps": self._setting.fps,
            "video.channels": kind.channels,
            "has_audio": False,
            **kind.info,
        }
        shape = [height, width, kind.channels]
        return {"dtype": "video", "shape": shape, "names": ["height", "width", "channels"], "info": info}

    def _write_json(self, name: str, content: Mapping[str, Any]) -> None:
        text = json.dumps(content, indent=4, ensure_ascii=False) + "\n"
        (self._folder / name).write_text(text, encoding="utf-8")


def build_tasks_table(tasks: Mapping[str, int]) -> pa.Table:
    """Build the numbered instructions; pandas reads the instruction as index, as LeRobot expects."""
    column = {"field_name": "task_index", "pandas_type": "int64", "numpy_type": "int64", "metadata": None}
    index = {"field_name": "task", "pandas_type": "unicode", "numpy_type": "object", "metadata": None}
    frame = {
        "index_columns": ["task"],
        "column_indexes": [],
        "columns": [{"name": "task_index", **column}, {"name": "task", **index}],
        "pandas_version": "2.2.0",
    }
    table = pa.table({"task_index": pa.array(tasks.values(), pa.int64()), "task": pa.array(tasks, pa.string())})
    return table.replace_schema_metadata({b"pandas": json.dumps(frame).encode()})


def _format_path(template: str, number: int, **names: str) -> str:
    return template.format(chunk_index=number // CHUNK_FILES, file_index=number % CHUNK_FILES, **names)


def _write_parquet(path: Path, tables: list[pa.Table]) -> None:
    """Write a row group per table, so that readers find episodes without scanning."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with pq.ParquetWriter(path, tables[0].schema, compression="snappy") as writer:
        for table in tables:
            writer.write_table(table)
