//! Log files derived from log files: repaired, recompressed, joined, split. Each is written completely or not
//! at all, and never replaces another file.

use std::fs::File;
use std::io::BufWriter;
use std::path::{Path, PathBuf};

use output_file::{OutputError, OutputFile, WholeFile, keep_all};
use run_log::join::RunOutputs;
use run_log::repair::{Repair, RepairReport};
use run_log::{LogError, LogSource, Packing, join};

use crate::log_file::LogFile;

/// Size of a log file before and after, in bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Sizes {
    /// Size of the input.
    pub before: u64,
    /// Size of the output.
    pub after: u64,
}

/// An output file not yet in place, and its writer.
struct Draft {
    file: OutputFile,
    out: BufWriter<File>,
}

fn begin(path: &Path) -> Result<Draft, LogError> {
    let file = OutputFile::create(path).map_err(output_error)?;
    let out = BufWriter::with_capacity(1 << 20, file.handle().map_err(output_error)?);
    Ok(Draft { file, out })
}

fn output_error(error: OutputError) -> LogError {
    match error {
        OutputError::Exists { path } => LogError::Exists { path },
        OutputError::Create { path, source } => LogError::Create { path, source },
        OutputError::Write { path, source } => LogError::Write { path, source },
    }
}

/// Repairs `input` into the new file `output`. Does not change the input.
///
/// # Errors
/// [`LogError::NotMcap`], [`LogError::NoHeader`] if both copies of the header are lost, [`LogError::Exists`],
/// and any disk error; then there is no output.
pub fn repair(input: &Path, output: &Path) -> Result<RepairReport, LogError> {
    let input = LogFile::at(input);
    let repair = Repair::of(&input)?;
    let Draft { file, out } = begin(output)?;
    let (out, mut report) = repair.write(out, output)?;
    drop(out);
    let repaired = file.finish().map_err(output_error)?;
    report.judge(&input, &LogFile::at(repaired.draft()))?;
    repaired.keep().map_err(output_error)?;
    Ok(report)
}

/// Recompresses a log's chunks into the new file `output`, and reads the result back to check that it
/// contains the same messages in the same order.
///
/// # Errors
/// [`LogError::NotWhole`], [`LogError::Exists`], any disk error; then there is no output.
pub fn compress(input: &Path, output: &Path, packing: Packing) -> Result<Sizes, LogError> {
    let log = LogFile::at(input);
    let Draft { file, out } = begin(output)?;
    drop(join::compress(&log, out, output, packing)?);
    let packed = file.finish().map_err(output_error)?;
    join::check_packed(&log, &LogFile::at(packed.draft()), output)?;
    let bytes = |path: &Path| {
        let found = std::fs::metadata(path).map(|metadata| metadata.len());
        found.map_err(|source| LogError::Open { path: path.into(), source })
    };
    let sizes = Sizes { before: bytes(input)?, after: bytes(&packed.draft())? };
    packed.keep().map_err(output_error)?;
    Ok(sizes)
}

/// Concatenates complete logs into one new file, run after run; [`split`] undoes it.
///
/// # Errors
/// [`LogError::NotWhole`] (also for a file of several runs), [`LogError::Exists`], any disk error.
pub fn cat_files(inputs: &[PathBuf], output: &Path) -> Result<(), LogError> {
    let Draft { file, out } = begin(output)?;
    let inputs: Vec<LogFile> = inputs.iter().map(LogFile::at).collect();
    let inputs: Vec<&dyn LogSource> = inputs.iter().map(|input| input as &dyn LogSource).collect();
    drop(join::cat_files(&inputs, out, output)?);
    file.keep().map_err(output_error)
}

/// Splits a file of several runs into one log per run: `run1.mcap`, `run2.mcap`, … in the folder `output`.
/// Returns their paths.
///
/// # Errors
/// [`LogError::NotWhole`], [`LogError::OneRun`], [`LogError::Exists`], any disk error.
pub fn split(input: &Path, output: &Path) -> Result<Vec<PathBuf>, LogError> {
    let input = LogFile::at(input);
    join::check_holds_runs(&input)?;
    output_file::create_folder(output).map_err(|source| LogError::Create { path: output.into(), source })?;
    let mut files = RunFiles { folder: output, begun: None, whole: Vec::new() };
    join::split(&input, &mut files)?;
    let paths = files.whole.iter().map(|file| file.path().to_owned()).collect();
    // All files are kept, or none.
    keep_all(files.whole).map_err(output_error)?;
    Ok(paths)
}

/// One file per run of a log being split.
struct RunFiles<'f> {
    folder: &'f Path,
    begun: Option<OutputFile>,
    whole: Vec<WholeFile>,
}

impl RunOutputs for RunFiles<'_> {
    type Output = BufWriter<File>;

    fn path(&self) -> &Path {
        self.folder
    }

    fn path_of(&self, run: usize) -> PathBuf {
        self.folder.join(format!("run{run}.mcap"))
    }

    fn begin(&mut self, run: usize) -> Result<BufWriter<File>, LogError> {
        let Draft { file, out } = begin(&self.path_of(run))?;
        self.begun = Some(file);
        Ok(out)
    }

    fn end(&mut self, _flushed: BufWriter<File>) -> Result<(), LogError> {
        if let Some(file) = self.begun.take() {
            self.whole.push(file.finish().map_err(output_error)?);
        }
        Ok(())
    }
}
