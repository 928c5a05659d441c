//! Folder of a sweep.

use std::io::ErrorKind;
use std::path::{Path, PathBuf};

use foreign_text::foreign_path;
use ipc_types::scene::Scene;
use ipc_types::text_file::read_bytes;
use output_file::OutputError;
use recorder_proc::build_info;
use serde::{Deserialize, Serialize};
use sweep::Study;

use super::parquet;
use super::row::Row;
use crate::failure::Failure;
use crate::scenes::{BuiltIn, SceneSource};

/// Largest row read, bytes; its 64 parameters and its results take a few thousand.
const MAX_ROW_BYTES: u64 = 1 << 20;

/// Identity of a sweep; rows of sweeps with another identity are rejected.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
struct Identity {
    study: String,
    points: Option<String>,
    scene: String,
    build: String,
    count: u64,
    keys: Vec<String>,
}

/// A study with the files it refers to.
#[derive(Debug)]
pub struct OpenedStudy {
    pub study: Study,
    /// Path of the scene, before any setting is applied.
    pub scene: Option<PathBuf>,
    identity: Identity,
}

impl OpenedStudy {
    /// Reads a study and the files it refers to, with paths relative to the study.
    ///
    /// # Errors
    /// Bad input: not a study, an unreadable file, or an unknown scene key.
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
        let identity = Identity {
            scene: SceneSource::new(scene.as_deref(), BuiltIn::Femur).text()?,
            study: text,
            points,
            build: build_info::current().version,
            count: study.count(),
            keys: study.keys().into_iter().map(str::to_owned).collect(),
        };
        let study = OpenedStudy { study, scene, identity };
        study.first_scene()?.has_the_keys()?;
        Ok(study)
    }

    /// Returns the scene of the first point.
    fn first_scene(&self) -> Result<SceneSource, Failure> {
        let source = SceneSource::new(self.scene.as_deref(), BuiltIn::Femur);
        source.with(&self.settings(&self.study.point(0)))
    }

    /// Refuses a scene that waits for a controller which no sweep can start. A point can still change its
    /// controllers, so each is checked again.
    ///
    /// # Errors
    /// Bad input: a required controller is external.
    pub fn refuse_external(&self) -> Result<(), Failure> {
        // A point whose scene is refused gets a row.
        self.first_scene()?.load().map_or(Ok(()), |scene| refuse_external(&scene))
    }

    /// Returns the settings of a run in the order of application.
    pub fn settings(&self, point: &sweep::Point) -> Vec<String> {
        [self.study.set.clone(), point.settings()].concat()
    }

    /// Returns the arguments of `trabecula run` for a run.
    pub fn arguments(&self, point: &sweep::Point) -> Vec<String> {
        let mut words: Vec<String> = self.scene.iter().map(|scene| scene.display().to_string()).collect();
        words.extend(["--mode".to_owned(), "lockstep".to_owned()]);
        words.extend(self.settings(point).into_iter().flat_map(|setting| ["--set".to_owned(), setting]));
        words
    }

    /// Returns the command that repeats a run.
    pub fn command(&self, point: &sweep::Point) -> Result<String, Failure> {
        joined(&[vec!["trabecula".to_owned(), "run".to_owned()], self.arguments(point)].concat())
    }
}

/// Refuses a scene with a required controller that is external.
pub fn refuse_external(scene: &Scene) -> Result<(), Failure> {
    match scene.controller.iter().find(|controller| controller.external && !controller.optional) {
        None => Ok(()),
        Some(external) => Err(Failure::bad_input(format!(
            "controller `{}` is external, and a sweep cannot start it; give it a `command` in the scene",
            external.name
        ))),
    }
}

/// Quotes and joins words for a shell.
pub fn joined(words: &[String]) -> Result<String, Failure> {
    shlex::try_join(words.iter().map(String::as_str)).map_err(Failure::bad_input)
}

/// Folder of a sweep.
#[derive(Debug)]
pub struct Folder {
    path: PathBuf,
    identity: Identity,
    study: Study,
}

impl Folder {
    /// Opens the folder for a study, either new or of the same study and build.
    ///
    /// # Errors
    /// Bad input: the folder belongs to a different study or build, contains other files, or is not writable.
    pub fn take(path: &Path, study: &OpenedStudy) -> Result<Folder, Failure> {
        let identity = path.join("study.json");
        // Another worker may be writing `study.json`, or may have been killed while it did.
        let is_draft = |name: &std::ffi::OsStr| name.to_string_lossy().starts_with(output_file::DRAFT_PREFIX);
        let others = std::fs::read_dir(path)
            .map(|entries| entries.flatten().filter(|entry| !is_draft(&entry.file_name())).count());
        if others.unwrap_or(0) > 0 && !identity.exists() {
            return Err(Failure::bad_input(format!(
                "--output {}: not empty and not a sweep folder; expected a new folder or the folder of this \
                 sweep",
                foreign_path(path)
            )));
        }
        output_file::create_folder(path).map_err(Failure::folder(path))?;
        let text = serde_json::to_vec_pretty(&study.identity).map_err(Failure::failed)?;
        match output_file::write(&identity, text) {
            // Already present from this sweep, or from another worker that has just started.
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
                "--output {}: contains rows of a different {what}, which cannot be merged with this sweep; \
                 choose another folder",
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
            bad(format!("not a sweep folder; expected one written by `trabecula sweep run` ({cause})"))
        })?;
        let identity: Identity =
            serde_json::from_str(&text).map_err(|cause| bad(format!("study.json: {cause}")))?;
        let study =
            Study::parse(&identity.study, &file, identity.points.as_deref()).map_err(Failure::bad_input)?;
        // The number of rows to look for must not come from an altered file.
        if identity.count != study.count() {
            return Err(bad(format!(
                "study.json: `count` is {}, but its study has {} points",
                identity.count,
                study.count()
            )));
        }
        if !identity.keys.iter().eq(study.keys()) {
            return Err(bad("study.json: `keys` are not those of its study".to_owned()));
        }
        Ok(Folder { path: path.to_owned(), identity, study })
    }

    /// Returns its path.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Returns the number of points of its study.
    pub fn count(&self) -> u64 {
        self.identity.count
    }

    /// Returns the keys that its study varies.
    pub fn keys(&self) -> &[String] {
        &self.identity.keys
    }

    /// Returns whether two folders have the same study and build.
    pub fn is_of_the_same(&self, other: &Folder) -> bool {
        self.identity == other.identity
    }

    /// Returns the study, with its table of points, as it was run.
    pub fn study(&self) -> &Study {
        &self.study
    }

    fn row_file(&self, point: u64) -> PathBuf {
        self.path.join("rows").join(format!("{point:07}.json"))
    }

    /// Creates a folder for a run's log and returns its path relative to the sweep's. The name is unique,
    /// because a killed run may have left a folder, and another worker may be running the same point.
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
        Err(Failure::failed(format!("{}: no free name for a run's folder", foreign_path(&self.path))))
    }

    /// Returns a point's row if its run has ended.
    pub fn row(&self, point: u64) -> Result<Option<Row>, Failure> {
        let file = self.row_file(point);
        let text = match read_bytes(&file, MAX_ROW_BYTES) {
            Ok(text) => text,
            Err(cause) if cause.kind() == ErrorKind::NotFound => return Ok(None),
            Err(cause) => return Err(Failure::failed(format!("{}: {cause}", foreign_path(&file)))),
        };
        let no_row = |cause: String| {
            Failure::failed(format!(
                "{}: not a row of this sweep ({cause}); remove it to repeat its run",
                foreign_path(&file)
            ))
        };
        let row: Row = serde_json::from_slice(&text).map_err(|cause| no_row(cause.to_string()))?;
        let keys = row.parameters.iter().map(|(key, _)| key);
        if row.point != point || !keys.eq(self.keys()) {
            return Err(no_row("it has a different point or different parameters".to_owned()));
        }
        Ok(Some(row))
    }

    /// Returns all existing rows by number.
    pub fn rows(&self) -> Result<Vec<Row>, Failure> {
        (0..self.count()).filter_map(|point| self.row(point).transpose()).collect()
    }

    /// Saves a row. If another worker has saved it meanwhile, it is identical.
    pub fn keep(&self, row: &Row) -> Result<(), Failure> {
        let text = serde_json::to_vec(row).map_err(Failure::failed)?;
        match output_file::write(&self.row_file(row.point), text) {
            Ok(()) | Err(OutputError::Exists { .. }) => Ok(()),
            Err(other) => Err(other.into()),
        }
    }

    /// Writes the rows into a file of `table/`, replacing an existing one. Returns its path.
    pub fn write_table(&self, name: &str, rows: &[Row]) -> Result<PathBuf, Failure> {
        let file = self.path.join("table").join(name);
        let bytes = parquet::table(self.keys(), rows)?;
        // Tables are generated from the rows, so replacing an older one loses nothing.
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
