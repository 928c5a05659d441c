//! The built-in scenes, and the choice of a command's scene.
//!
//! A command without a scene file uses one of these, so it works in any folder. Each is a file of `configs/`
//! that refers to no other file (no CT, no calibration), so it is self-contained wherever it is written.

use std::fmt;
use std::path::{Path, PathBuf};

use clap::ValueEnum;
use ipc_types::scene::{BACKSLASH, DECIMAL_COMMA, Scene, SceneError, is_number_with_comma, list_default};

use crate::failure::Failure;

/// A built-in scene.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum BuiltIn {
    /// Drills a curve into a synthetic femur.
    #[value(name = "femur_curved_drilling")]
    Femur,
    /// Neither bone nor X-ray.
    #[value(name = "free_space")]
    FreeSpace,
    /// Sweeps the tendon, for `trabecula calibrate`.
    #[value(name = "tension_sweep")]
    TensionSweep,
}

impl BuiltIn {
    /// Name of the scene; with `.toml`, of its file.
    pub fn name(self) -> &'static str {
        match self {
            BuiltIn::Femur => "femur_curved_drilling",
            BuiltIn::FreeSpace => "free_space",
            BuiltIn::TensionSweep => "tension_sweep",
        }
    }

    /// The scene's text.
    pub fn text(self) -> &'static str {
        match self {
            BuiltIn::Femur => include_str!("../../../configs/femur_curved_drilling.toml"),
            BuiltIn::FreeSpace => include_str!("../../../configs/free_space.toml"),
            BuiltIn::TensionSweep => include_str!("../../../configs/tension_sweep.toml"),
        }
    }

    /// The parsed scene.
    ///
    /// # Errors
    /// None for this build's texts (a test parses them all).
    pub fn scene(self) -> Result<Scene, Failure> {
        Scene::parse(self.text(), Path::new(&format!("built-in {}.toml", self.name())))
            .map_err(Failure::bad_input)
    }
}

/// The scene of a command.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum SceneSource {
    /// The user's file.
    File(PathBuf),
    /// The user named no file.
    BuiltIn(BuiltIn),
    /// Another source, with keys set on the command line.
    Changed {
        /// The original scene.
        source: Box<SceneSource>,
        /// Its text with the keys set.
        text: String,
    },
}

impl SceneSource {
    /// The named file, or else the built-in scene.
    pub fn new(file: Option<&Path>, built_in: BuiltIn) -> SceneSource {
        file.map_or(SceneSource::BuiltIn(built_in), |file| SceneSource::File(file.to_owned()))
    }

    /// The same scene with keys set, each by a line `KEY=VALUE`: the key's path, with an index (from 0) for a
    /// table of an array, and the value as in TOML.
    ///
    /// # Errors
    /// Bad input: a malformed line, a path through something that is not a table, or a scene that is not
    /// TOML.
    pub fn with(self, settings: &[String]) -> Result<SceneSource, Failure> {
        if settings.is_empty() {
            return Ok(self);
        }
        let original = self.text()?;
        // A text that is not TOML is refused as it would be without the settings.
        let Ok(mut scene) = original.parse::<toml::Table>() else { return Ok(self) };
        for line in settings {
            let refused = |why: String| Failure::bad_input(format!("--set {line}: {why}"));
            let (key, written) =
                line.split_once('=').ok_or_else(|| refused("expected KEY=VALUE".to_owned()))?;
            let value = format!("value = {}", written.trim()).parse::<toml::Table>();
            let value = value.ok().and_then(|mut table| table.remove("value"));
            let value = value.ok_or_else(|| match is_number_with_comma(written.trim()) {
                true => refused(DECIMAL_COMMA.to_owned()),
                false if written.contains('\\') => refused(BACKSLASH.to_owned()),
                false => refused(
                    "the value is not TOML; a string needs quotes inside the shell's quotes, as in \
                     'name=\"a\"'"
                        .to_owned(),
                ),
            })?;
            let key = key.trim();
            if let Some((list, _)) = key.rsplit_once('.').filter(|(_, last)| last.parse::<usize>().is_ok())
                && !has(&scene, list)
                && let Some(default) = list_default(list)
            {
                set(&mut scene, list, default).map_err(refused)?;
            }
            set(&mut scene, key, value).map_err(refused)?;
        }
        let text = toml::to_string(&scene).map_err(|cause| Failure::bad_input(format!("--set: {cause}")))?;
        Ok(SceneSource::Changed { source: Box::new(self), text })
    }

    /// The scene's file name in errors; relative paths in the scene are relative to its folder.
    fn path(&self) -> PathBuf {
        match self {
            SceneSource::File(file) => file.clone(),
            SceneSource::BuiltIn(scene) => PathBuf::from(format!("built-in {}.toml", scene.name())),
            SceneSource::Changed { source, .. } => source.path(),
        }
    }

    /// Loads and validates the scene.
    ///
    /// # Errors
    /// Bad input: the file is not a scene.
    pub fn load(&self) -> Result<Scene, Failure> {
        self.parsed().map_err(|error| self.refused(error))
    }

    /// Checks only that a scene has known keys with values of the right types, not their ranges.
    ///
    /// # Errors
    /// Bad input: an unknown or missing key, or a value of a wrong type.
    pub fn has_the_keys(&self) -> Result<(), Failure> {
        match self.parsed() {
            Err(error @ SceneError::Malformed { .. }) => Err(self.refused(error)),
            _ => Ok(()),
        }
    }

    fn parsed(&self) -> Result<Scene, SceneError> {
        let text = match self {
            SceneSource::File(file) => return ipc_types::scene_file::load(file),
            SceneSource::BuiltIn(scene) => scene.text(),
            SceneSource::Changed { text, .. } => text,
        };
        ipc_types::scene_file::parse(text, &self.path())
    }

    fn refused(&self, error: SceneError) -> Failure {
        Failure::bad_input(match (self, error) {
            // The line refers to a generated text that the user has not seen.
            (SceneSource::Changed { .. }, SceneError::Malformed { file, cause, .. }) => {
                format!("{} with --set: {cause}", file.display())
            }
            (_, other) => other.to_string(),
        })
    }

    /// The scene's text, as its author wrote it.
    ///
    /// # Errors
    /// Bad input: the file cannot be read.
    pub fn text(&self) -> Result<String, Failure> {
        match self {
            SceneSource::File(file) => crate::text::read(file),
            SceneSource::BuiltIn(scene) => Ok(scene.text().to_owned()),
            SceneSource::Changed { text, .. } => Ok(text.clone()),
        }
    }

    /// The argument that names the scene in another call of the same command; `None` for a built-in one.
    pub fn argument(&self) -> Option<&Path> {
        match self {
            SceneSource::File(file) => Some(file),
            SceneSource::BuiltIn(_) => None,
            SceneSource::Changed { source, .. } => source.argument(),
        }
    }
}

/// Whether a table has a key, by its path through tables.
fn has(table: &toml::Table, path: &str) -> bool {
    match path.split_once('.') {
        None => table.contains_key(path),
        Some((first, rest)) => match table.get(first) {
            Some(toml::Value::Table(below)) => has(below, rest),
            // An index of an array; `set` reports what does not exist.
            Some(_) => true,
            None => false,
        },
    }
}

/// Sets a key of a table, and creates the tables on its path.
fn set(table: &mut toml::Table, path: &str, value: toml::Value) -> Result<(), String> {
    let Some((first, rest)) = path.split_once('.') else {
        if path.is_empty() {
            return Err("a key is empty".to_owned());
        }
        table.insert(path.to_owned(), value);
        return Ok(());
    };
    let below = table.entry(first).or_insert_with(|| toml::Value::Table(toml::Table::new()));
    match below {
        toml::Value::Table(below) => set(below, rest, value),
        toml::Value::Array(tables) => {
            let count = tables.len();
            let (index, rest) = rest.split_once('.').unwrap_or((rest, ""));
            let entry = index.parse::<usize>().ok().and_then(|index| tables.get_mut(index));
            match entry {
                Some(toml::Value::Table(below)) => set(below, rest, value),
                Some(entry) if rest.is_empty() => {
                    *entry = value;
                    Ok(())
                }
                _ if count == 1 => Err(format!("`{first}` has 1 entry; expected index 0")),
                _ => Err(format!("`{first}` has {count} entries; expected an index from 0")),
            }
        }
        _ => Err(format!("`{first}` is not a table")),
    }
}

impl fmt::Display for SceneSource {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            SceneSource::File(file) => write!(out, "{}", file.display()),
            SceneSource::BuiltIn(scene) => write!(out, "the built-in scene `{}`", scene.name()),
            SceneSource::Changed { source, .. } => source.fmt(out),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_built_in_scene_is_valid_bears_its_file_name_and_names_no_other_file() {
        for built_in in BuiltIn::value_variants() {
            let scene = built_in.scene().unwrap();
            let file = built_in.to_possible_value().unwrap();
            assert_eq!((scene.name.as_str(), file.get_name()), (built_in.name(), built_in.name()));
            assert_eq!(scene.volume.as_ref().and_then(|volume| volume.path.as_ref()), None);
            for controller in &scene.controller {
                assert_eq!(controller.command, None);
                let drilling = controller.curved_drilling.as_ref();
                assert_eq!(drilling.and_then(|drilling| drilling.calibration.as_ref()), None);
            }
        }
    }

    #[test]
    fn keys_that_are_set_replace_those_of_the_scene_and_bad_ones_are_refused_by_name() {
        let with = |lines: &[&str]| {
            let lines: Vec<String> = lines.iter().map(|line| (*line).to_owned()).collect();
            SceneSource::BuiltIn(BuiltIn::Femur).with(&lines).and_then(|source| source.load())
        };
        let scene =
            with(&["run.duration_s=0.5", "controller.0.name=\"mine\"", "tool.bend_toward.2 = 0.5"]).unwrap();
        assert_eq!((scene.run.duration_s, scene.controller[0].name.as_str()), (0.5, "mine"));
        assert_eq!(scene.tool.bend_toward[2], 0.5);
        for (line, said) in [
            ("run.duration_s", "expected KEY=VALUE"),
            ("run.duration_s=long", "the value is not TOML"),
            ("volume.path=\"C:\\Users\\ct.nrrd\"", "write a path in single quotes"),
            ("run.duration_s=-1", "`run.duration_s` is -1; allowed: 0.001 to 86400"),
            (
                "run.duration_s=\"long\"",
                "with --set: `run.duration_s`: invalid type: string \"long\", expected a number",
            ),
            ("name.x=1", "`name` is not a table"),
            ("controller.7.name=\"a\"", "`controller` has 1 entry; expected index 0"),
            ("run.=1", "a key is empty"),
        ] {
            let error = with(&[line]).unwrap_err();
            assert!(error.code == 2 && error.message.contains(said), "{line}: {}", error.message);
        }
    }
}
