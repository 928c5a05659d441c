//! Encodes runs as a data set of LeRobot, format v3.0 (`CODEBASE_VERSION` of `lerobot/datasets`), which
//! `LeRobotDataset` reads: an episode is a file of rows below `data`, and `meta` describes all of them.

mod statistics;

use std::io::Write;
use std::ops::Range;
use std::path::PathBuf;

use recorder_proc::parquet_table::{Column, ParquetError, TableWriter};
use serde_json::{Value, json};

use super::DatasetFile;
use statistics::Statistics;

/// Name of the X-ray's feature; LeRobot takes features with `image` in their name for pictures.
pub const PICTURE: &str = "observation.images.xray";
/// Rows of a group in a file, which are in memory until it is full.
const GROUP: usize = 1000;
/// Files in a folder, LeRobot's default.
const CHUNK: usize = 1000;

/// What every row of a data set has.
#[derive(Debug, Clone, PartialEq)]
pub struct Features {
    /// Names of the elements of `observation.state`.
    pub state: Vec<String>,
    /// Names of the elements of `action`.
    pub action: Vec<String>,
    /// Columns and rows of the X-ray, if rows have one.
    pub picture: Option<[u32; 2]>,
    /// Whether the scene has a target, and so rows a reward.
    pub has_reward: bool,
}

/// A row without what follows from its place.
#[derive(Debug, Clone, Default)]
pub struct Row {
    pub state: Vec<f32>,
    pub action: Vec<f32>,
    pub picture: Option<Picture>,
    pub reward: f32,
}

/// An X-ray of a row.
#[derive(Debug, Clone)]
pub struct Picture {
    /// Encoded, with three equal channels.
    pub png: Vec<u8>,
    /// How many of its pixels have each grey.
    pub pixels: [u64; 256],
}

/// A data set being built.
#[derive(Debug)]
pub struct LeRobot {
    features: Features,
    rate_hz: u32,
    robot: String,
    tasks: Vec<String>,
    episodes: Vec<EpisodeEntry>,
    rows: usize,
}

/// What `meta` says about an episode.
#[derive(Debug)]
struct EpisodeEntry {
    task: usize,
    rows: usize,
    statistics: Vec<(String, Statistics)>,
}

impl LeRobot {
    /// Creates an empty data set with this many rows per second of simulated time.
    pub fn new(features: Features, rate_hz: u32, robot: &str) -> LeRobot {
        let robot = robot.to_owned();
        LeRobot { features, rate_hz, robot, tasks: Vec::new(), episodes: Vec::new(), rows: 0 }
    }

    /// Returns the numbers of episodes and rows.
    pub fn counts(&self) -> [usize; 2] {
        [self.episodes.len(), self.rows]
    }

    /// Returns the path of the next episode's file in the folder.
    pub fn next_file(&self) -> PathBuf {
        let [chunk, file] = place_of(self.episodes.len());
        PathBuf::from(format!("data/chunk-{chunk:03}/file-{file:03}.parquet"))
    }

    /// Starts the next episode in a file.
    ///
    /// # Errors
    /// Any error of the `parquet` library or the output.
    pub fn start<W: Write + Send>(&mut self, out: W, task: &str) -> Result<Episode<W>, ParquetError> {
        let known = self.tasks.iter().position(|other| other == task);
        let task = known.unwrap_or_else(|| {
            self.tasks.push(task.to_owned());
            self.tasks.len() - 1
        });
        Episode::new(out, self, task)
    }

    /// Adds an episode that has ended; returns its output.
    ///
    /// # Errors
    /// As [`start`](Self::start).
    pub fn add<W: Write + Send>(
        &mut self,
        mut episode: Episode<W>,
        success: bool,
    ) -> Result<W, ParquetError> {
        episode.write(episode.rows - episode.written, Some(success))?;
        let statistics = episode.statistics(success);
        self.episodes.push(EpisodeEntry { task: episode.task, rows: episode.rows, statistics });
        self.rows += episode.rows;
        episode.writer.end()
    }

    /// Returns the files of `meta`; `info.json` is the last one, without which a folder is incomplete.
    ///
    /// # Errors
    /// As [`start`](Self::start).
    pub fn end(self) -> Result<Vec<DatasetFile>, ParquetError> {
        let file = |name: &str, bytes: Vec<u8>| (PathBuf::from("meta").join(name), bytes);
        let text = |value: &Value| format!("{value:#}\n").into_bytes();
        Ok(vec![
            file("tasks.parquet", self.tasks_table()?),
            file("episodes/chunk-000/file-000.parquet", self.episodes_table()?),
            file("stats.json", text(&self.statistics())),
            file("info.json", text(&self.info())),
        ])
    }

    fn statistics(&self) -> Value {
        let Some(first) = self.episodes.first() else { return json!({}) };
        let entry = |(at, (name, _)): (usize, &(String, Statistics))| {
            let all = self.episodes.iter().filter_map(|episode| episode.statistics.get(at));
            let parts: Vec<&Statistics> = all.map(|(_, statistics)| statistics).collect();
            Some((name.clone(), Statistics::combined(&parts)?.json()))
        };
        first.statistics.iter().enumerate().filter_map(entry).collect()
    }

    fn info(&self) -> Value {
        json!({
            "codebase_version": "v3.0",
            "robot_type": self.robot,
            "total_episodes": self.episodes.len(),
            "total_frames": self.rows,
            "total_tasks": self.tasks.len(),
            "chunks_size": CHUNK,
            "data_files_size_in_mb": 100,
            "video_files_size_in_mb": 200,
            "fps": self.rate_hz,
            "splits": {"train": format!("0:{}", self.episodes.len())},
            "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
            "video_path": null,
            "features": self.features.json(),
        })
    }

    /// A table of `task_index` with the texts as pandas' index.
    fn tasks_table(&self) -> Result<Vec<u8>, ParquetError> {
        let columns = [
            ("task_index".to_owned(), Column::Integers((0..self.tasks.len() as i64).collect())),
            ("__index_level_0__".to_owned(), Column::Texts(self.tasks.iter().cloned().map(Some).collect())),
        ];
        let described = |name: Value, field: &str, kind: &str, numpy: &str| {
            json!({
                "name": name, "field_name": field, "pandas_type": kind, "numpy_type": numpy, "metadata": null,
            })
        };
        let pandas = json!({
            "index_columns": ["__index_level_0__"],
            "column_indexes": [],
            "columns": [
                described(json!("task_index"), "task_index", "int64", "int64"),
                described(Value::Null, "__index_level_0__", "unicode", "object"),
            ],
            "pandas_version": "2.2.3",
        });
        let mut writer = TableWriter::new(Vec::new(), "tasks", &columns, &[("pandas", pandas.to_string())])?;
        writer.rows(&columns)?;
        writer.end()
    }

    fn episodes_table(&self) -> Result<Vec<u8>, ParquetError> {
        let count = self.episodes.len();
        let mut starts = vec![0_i64];
        starts.extend(self.episodes.iter().scan(0, |end, episode| {
            *end += episode.rows as i64;
            Some(*end)
        }));
        let each = |of: &dyn Fn(usize) -> i64| Column::Integers((0..count).map(of).collect());
        let rows = |episode: &EpisodeEntry| episode.rows as i64;
        let task = |episode: &EpisodeEntry| self.tasks.get(episode.task).cloned().into_iter().collect();
        let mut columns = vec![
            ("episode_index", each(&|index| index as i64)),
            ("tasks", Column::TextLists(self.episodes.iter().map(task).collect())),
            ("length", Column::Integers(self.episodes.iter().map(rows).collect())),
            ("data/chunk_index", each(&|index| place_of(index)[0] as i64)),
            ("data/file_index", each(&|index| place_of(index)[1] as i64)),
            ("dataset_from_index", each(&|index| starts[index])),
            ("dataset_to_index", each(&|index| starts[index + 1])),
            ("meta/episodes/chunk_index", each(&|_| 0)),
            ("meta/episodes/file_index", each(&|_| 0)),
        ]
        .into_iter()
        .map(|(name, column)| (name.to_owned(), column))
        .collect::<Vec<_>>();
        let mut named: Vec<(String, Vec<Vec<f64>>)> = Vec::new();
        for episode in &self.episodes {
            let all = episode.statistics.iter().flat_map(|(feature, statistics)| {
                statistics
                    .named()
                    .into_iter()
                    .map(move |(name, values)| (format!("stats/{feature}/{name}"), values))
            });
            for (name, values) in all {
                match named.iter_mut().find(|(other, _)| *other == name) {
                    Some((_, lists)) => lists.push(values),
                    None => named.push((name, vec![values])),
                }
            }
        }
        columns.extend(named.into_iter().map(|(name, lists)| (name, Column::NumberLists(lists))));
        let mut writer = TableWriter::new(Vec::new(), "episodes", &columns, &[])?;
        writer.rows(&columns)?;
        writer.end()
    }
}

/// Chunk and file of an episode: each has a file of its own.
fn place_of(episode: usize) -> [usize; 2] {
    [episode / CHUNK, episode % CHUNK]
}

impl Features {
    /// Returns the entry of `info.json`.
    fn json(&self) -> Value {
        let vector = |names: &[String]| json!({"dtype": "float32", "shape": [names.len()], "names": names});
        let scalar = |dtype: &str| json!({"dtype": dtype, "shape": [1], "names": null});
        let mut all = json!({"observation.state": vector(&self.state), "action": vector(&self.action)});
        if let Some([columns, rows]) = self.picture {
            let names = ["height", "width", "channels"];
            all[PICTURE] = json!({"dtype": "image", "shape": [rows, columns, 3], "names": names});
        }
        if self.has_reward {
            all["next.reward"] = scalar("float32");
            all["next.success"] = scalar("bool");
        }
        all["next.done"] = scalar("bool");
        all["timestamp"] = scalar("float32");
        for name in ["frame_index", "episode_index", "index", "task_index"] {
            all[name] = scalar("int64");
        }
        all
    }
}

/// An episode being written: its numbers stay in memory for the statistics, its pictures until they are
/// written.
pub struct Episode<W: Write + Send> {
    writer: TableWriter<W>,
    features: Features,
    rate_hz: u32,
    episode: usize,
    task: usize,
    first_index: usize,
    rows: usize,
    written: usize,
    state: Vec<f32>,
    action: Vec<f32>,
    reward: Vec<f32>,
    pictures: Vec<Vec<u8>>,
    /// How many pixels of all pictures have each grey.
    pixels: [u64; 256],
}

impl<W: Write + Send> Episode<W> {
    fn new(out: W, set: &LeRobot, task: usize) -> Result<Episode<W>, ParquetError> {
        let columns = Rows::default().columns(&set.features);
        Ok(Episode {
            writer: TableWriter::new(out, "rows", &columns, &[])?,
            features: set.features.clone(),
            rate_hz: set.rate_hz,
            episode: set.episodes.len(),
            task,
            first_index: set.rows,
            rows: 0,
            written: 0,
            state: Vec::new(),
            action: Vec::new(),
            reward: Vec::new(),
            pictures: Vec::new(),
            pixels: [0; 256],
        })
    }

    /// Adds a row.
    ///
    /// # Errors
    /// As [`LeRobot::start`].
    pub fn add(&mut self, row: Row) -> Result<(), ParquetError> {
        // Not the last row so far, which may be the last of the episode.
        if self.rows - self.written > GROUP {
            self.write(GROUP, None)?;
        }
        self.state.extend(row.state);
        self.action.extend(row.action);
        self.reward.push(row.reward);
        if let Some(picture) = row.picture {
            self.pictures.push(picture.png);
            self.pixels.iter_mut().zip(&picture.pixels).for_each(|(sum, count)| *sum += count);
        }
        self.rows += 1;
        Ok(())
    }

    /// Writes the next rows; with `success`, the last of them ends the episode.
    fn write(&mut self, count: usize, success: Option<bool>) -> Result<(), ParquetError> {
        if count == 0 {
            return Ok(());
        }
        let pictures = self.pictures.drain(..count.min(self.pictures.len())).collect();
        let rows = self.columns_of(self.written..self.written + count, success, pictures);
        self.writer.rows(&rows.columns(&self.features))?;
        self.written += count;
        Ok(())
    }

    fn columns_of(&self, range: Range<usize>, success: Option<bool>, pictures: Vec<Vec<u8>>) -> Rows {
        let part = |values: &[f32], width: usize| {
            values.get(range.start * width..range.end * width).unwrap_or_default().to_vec()
        };
        let at_end = |value: bool| (range.clone()).map(|frame| value && frame + 1 == range.end).collect();
        Rows {
            state: part(&self.state, self.features.state.len()),
            action: part(&self.action, self.features.action.len()),
            pictures,
            reward: part(&self.reward, 1),
            success: at_end(success == Some(true)),
            done: at_end(success.is_some()),
            timestamp: range.clone().map(|frame| (frame as f64 / f64::from(self.rate_hz)) as f32).collect(),
            frame: range.clone().map(|frame| frame as i64).collect(),
            episode: vec![self.episode as i64; range.len()],
            index: range.clone().map(|frame| (self.first_index + frame) as i64).collect(),
            task: vec![self.task as i64; range.len()],
        }
    }

    /// Statistics of every feature over the whole episode.
    fn statistics(&self, success: bool) -> Vec<(String, Statistics)> {
        let rows = self.columns_of(0..self.rows, Some(success), Vec::new());
        let of_column = |(name, column): (String, Column)| {
            let (width, values): (usize, Vec<f32>) = match column {
                Column::FloatLists(width, values) => (width, values),
                Column::Floats(values) => (1, values),
                Column::Flags(values) => (1, values.iter().map(|flag| f32::from(u8::from(*flag))).collect()),
                Column::Integers(values) => (1, values.iter().map(|value| *value as f32).collect()),
                _ => return (name, Statistics::of_pictures(self.rows as u64, &self.pixels)),
            };
            (name, Statistics::of_rows(width, &values))
        };
        rows.columns(&self.features).into_iter().map(of_column).collect()
    }
}

/// Columns of some rows.
#[derive(Debug, Default)]
struct Rows {
    state: Vec<f32>,
    action: Vec<f32>,
    pictures: Vec<Vec<u8>>,
    reward: Vec<f32>,
    success: Vec<bool>,
    done: Vec<bool>,
    timestamp: Vec<f32>,
    frame: Vec<i64>,
    episode: Vec<i64>,
    index: Vec<i64>,
    task: Vec<i64>,
}

impl Rows {
    /// Returns the columns in the order of `info.json`. A feature with a single element is a plain number.
    fn columns(self, features: &Features) -> Vec<(String, Column)> {
        let vector = |width: usize, values| match width {
            1 => Column::Floats(values),
            _ => Column::FloatLists(width, values),
        };
        let mut columns = vec![
            ("observation.state", vector(features.state.len(), self.state)),
            ("action", vector(features.action.len(), self.action)),
        ];
        if features.picture.is_some() {
            columns.push((PICTURE, Column::Pictures(self.pictures)));
        }
        if features.has_reward {
            columns.push(("next.reward", Column::Floats(self.reward)));
            columns.push(("next.success", Column::Flags(self.success)));
        }
        columns.extend([
            ("next.done", Column::Flags(self.done)),
            ("timestamp", Column::Floats(self.timestamp)),
            ("frame_index", Column::Integers(self.frame)),
            ("episode_index", Column::Integers(self.episode)),
            ("index", Column::Integers(self.index)),
            ("task_index", Column::Integers(self.task)),
        ]);
        columns.into_iter().map(|(name, column)| (name.to_owned(), column)).collect()
    }
}
