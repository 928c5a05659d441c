//! A sweep's folder.

use std::io::ErrorKind;
use std::path::{Path, PathBuf};

use foreign_text::foreign_path;
use output_file::OutputError;
use recorder_proc::build_info;
use serde::{Deserialize, Serialize};
use sweep::Study;

use super::parquet;
use super::row::Row;
use crate::failure::Failure;
use crate::scenes::{BuiltIn, SceneSource};

/// What a folder is a sweep of; rows of another are no rows of this.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
struct Identity {
    study: String,
    points: Option<String>,
    scene: String,
    build: String,
    count: u64,
    keys: Vec<String>,
}

/// A study with the files that it names.
#[derive(Debug)]
pub struct OpenedStudy {
    pub study: Study,
    /// Its scene, before any setting.
    pub scene: Option<PathBuf>,
    identity: Identity,
}

impl OpenedStudy {
    /// Reads a study and the files that it names; those lie from its own folder.
    ///
    /// # Errors
    /// Bad input: not a study, a file that cannot be read, or a key that no scene has.
    pub fn read(file: &Path) -> Result<OpenedStudy, Failure> {
        let text = inputs::text::read(file)?;
        let place = |named: PathBuf| {
            let above = file.parent().unwrap_or(Path::new(""));
            std::path::absolute(above.join(named)).map_err(Failure::failed)
        };
        let points = Study::points_file(&text, file).map_err(Failure::bad_input)?.map(&place).transpose()?;
        let points = points.map(|points| inputs::text::read(&points)).transpose()?;
        let study = Study::parse(&text, file, points.as_deref()).map_err(Failure::bad_input)?;
        let scene = study.scene.clone().map(place).transpose()?;
        let source = SceneSource::new(scene.as_deref(), BuiltIn::Femur);
        let identity = Identity {
            scene: source.text()?,
            study: text,
            points,
            build: build_info::current().version,
            count: study.count(),
            keys: study.keys().into_iter().map(str::to_owned).collect(),
        };
        let study = OpenedStudy { study, scene, identity };
        source.with(&study.settings(&study.study.point(0)))?.has_the_keys()?;
        Ok(study)
    }

    /// Settings of a run, in the order in which they count.
    pub fn settings(&self, point: &sweep::Point) -> Vec<String> {
        [self.study.set.clone(), point.settings()].concat()
    }

    /// Arguments of `trabecula run` for a run.
    pub fn arguments(&self, point: &sweep::Point) -> Vec<String> {
        let mut words: Vec<String> = self.scene.iter().map(|scene| scene.display().to_string()).collect();
        words.extend(["--mode".to_owned(), "lockstep".to_owned()]);
        words.extend(self.settings(point).into_iter().flat_map(|setting| ["--set".to_owned(), setting]));
        words
    }

    /// The command that makes a run again.
    pub fn command(&self, point: &sweep::Point) -> Result<String, Failure> {
        joined(&[vec!["trabecula".to_owned(), "run".to_owned()], self.arguments(point)].concat())
    }
}

/// Words as a shell takes them.
pub fn joined(words: &[String]) -> Result<String, Failure> {
    shlex::try_join(words.iter().map(String::as_str)).map_err(Failure::bad_input)
}

/// A sweep's folder.
#[derive(Debug)]
pub struct Folder {
    path: PathBuf,
    identity: Identity,
}

impl Folder {
    /// Takes a folder for a study: a new one, or one of the same study and build.
    ///
    /// # Errors
    /// Bad input: the folder is of another study or build, or holds something else; it cannot be written.
    pub fn take(path: &Path, study: &OpenedStudy) -> Result<Folder, Failure> {
        let identity = path.join("study.json");
        // Another worker may be writing `study.json`, or may have been killed while it did.
        let is_draft = |name: &std::ffi::OsStr| name.to_string_lossy().starts_with(output_file::DRAFT_PREFIX);
        let others = std::fs::read_dir(path)
            .map(|entries| entries.flatten().filter(|entry| !is_draft(&entry.file_name())).count());
        if others.unwrap_or(0) > 0 && !identity.exists() {
            return Err(Failure::bad_input(format!(
                "--output {}: is not empty and no sweep's folder, expected a new folder or that of this sweep",
                foreign_path(path)
            )));
        }
        output_file::create_folder(path).map_err(Failure::folder(path))?;
        let text = serde_json::to_vec_pretty(&study.identity).map_err(Failure::failed)?;
        match output_file::write(&identity, text) {
            // Of this sweep, or of another worker of it that has just begun.
            Ok(()) | Err(OutputError::Exists { .. }) => {}
            Err(other) => return Err(other.into()),
        }
        let folder = Folder::open(path)?;
        let (ours, theirs) = (&study.identity, &folder.identity);
        let differs = [
            ("study", ours.study != theirs.study),
            ("table of points", ours.points != theirs.points),
            ("scene", ours.scene != theirs.scene),
            ("build of trabecula", ours.build != theirs.build),
        ];
        match differs.iter().find(|(_, differs)| *differs) {
            Some((what, _)) => Err(Failure::bad_input(format!(
                "--output {}: holds rows of another {what}, which cannot stand in one table with this sweep's; take another folder",
                foreign_path(path)
            ))),
            None => folder.with_subfolders(),
        }
    }

    fn with_subfolders(self) -> Result<Folder, Failure> {
        for below in ["rows", "runs", "table"].map(|name| self.path.join(name)) {
            output_file::create_folder(&below).map_err(Failure::folder(&below))?;
        }
        Ok(self)
    }

    /// Opens a folder with rows.
    pub fn open(path: &Path) -> Result<Folder, Failure> {
        let file = path.join("study.json");
        let bad = |why: String| Failure::bad_input(format!("{}: {why}", foreign_path(path)));
        let text = ipc_types::text_file::read(&file).map_err(|cause| {
            bad(format!(
                "is no folder of a sweep, expected one that `trabecula sweep run` has written ({cause})"
            ))
        })?;
        let identity = serde_json::from_str(&text).map_err(|cause| bad(format!("study.json: {cause}")))?;
        Ok(Folder { path: path.to_owned(), identity })
    }

    /// Where it is.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Number of points of its study.
    pub fn count(&self) -> u64 {
        self.identity.count
    }

    /// Keys that its study varies.
    pub fn keys(&self) -> &[String] {
        &self.identity.keys
    }

    /// Whether two folders are of the same study and build.
    pub fn is_of_the_same(&self, other: &Folder) -> bool {
        self.identity == other.identity
    }

    /// The study's text and the text of its table of points, as it was run.
    pub fn study(&self) -> Result<Study, Failure> {
        let file = self.path.join("study.json");
        Study::parse(&self.identity.study, &file, self.identity.points.as_deref()).map_err(Failure::bad_input)
    }

    fn row_file(&self, point: u64) -> PathBuf {
        self.path.join("rows").join(format!("{point:07}.json"))
    }

    /// Makes a folder for a run's log, from the sweep's. A run that was killed may have left one, and another
    /// worker may be making the same run: nobody gets a folder twice.
    pub fn claim_run(&self, point: u64) -> Result<PathBuf, Failure> {
        let first = format!("{point:07}");
        let names = std::iter::once(first.clone()).chain((2_u32..).map(|number| format!("{first}-{number}")));
        for run in names.map(|name| Path::new("runs").join(name)) {
            let folder = self.path.join(&run);
            match std::fs::create_dir(&folder) {
                Ok(()) => return Ok(run),
                Err(cause) if cause.kind() == ErrorKind::AlreadyExists => {}
                Err(cause) => return Err(Failure::folder(&folder)(cause)),
            }
        }
        Err(Failure::failed(format!("{}: no name left for a run's folder", foreign_path(&self.path))))
    }

    /// A point's row, if its run has ended.
    pub fn row(&self, point: u64) -> Result<Option<Row>, Failure> {
        let file = self.row_file(point);
        let text = match std::fs::read(&file) {
            Ok(text) => text,
            Err(cause) if cause.kind() == ErrorKind::NotFound => return Ok(None),
            Err(cause) => return Err(Failure::failed(format!("{}: {cause}", foreign_path(&file)))),
        };
        let no_row = |cause: String| {
            Failure::failed(format!(
                "{}: is no row of this sweep ({cause}); remove it, and its run is made again",
                foreign_path(&file)
            ))
        };
        let row: Row = serde_json::from_slice(&text).map_err(|cause| no_row(cause.to_string()))?;
        let keys = row.parameters.iter().map(|(key, _)| key);
        if row.point != point || !keys.eq(self.keys()) {
            return Err(no_row("it is of another point or has other parameters".to_owned()));
        }
        Ok(Some(row))
    }

    /// All rows that are there, by number.
    pub fn rows(&self) -> Result<Vec<Row>, Failure> {
        (0..self.count()).filter_map(|point| self.row(point).transpose()).collect()
    }

    /// Keeps a row. One that another worker has kept meanwhile is the same.
    pub fn keep(&self, row: &Row) -> Result<(), Failure> {
        let text = serde_json::to_vec(row).map_err(Failure::failed)?;
        match output_file::write(&self.row_file(row.point), text) {
            Ok(()) | Err(OutputError::Exists { .. }) => Ok(()),
            Err(other) => Err(other.into()),
        }
    }

    /// Writes the rows that are there into a file of `table/`, in place of an earlier one of the same name.
    /// Returns it.
    pub fn write_table(&self, name: &str, rows: &[Row]) -> Result<PathBuf, Failure> {
        let file = self.path.join("table").join(name);
        let bytes = parquet::table(self.keys(), rows)?;
        // The table is made of the rows: an earlier one of fewer rows says nothing else.
        match std::fs::remove_file(&file) {
            Err(cause) if cause.kind() != ErrorKind::NotFound => {
                return Err(Failure::failed(format!("{}: {cause}", foreign_path(&file))));
            }
            _ => {}
        }
        output_file::write(&file, bytes)?;
        Ok(file)
    }
}
