//! `compress`, `cat-files`, `split` — rewrite whole logs.

use std::collections::BTreeMap;
use std::io::Write;
use std::path::{Path, PathBuf};

use mcap::records::{Channel, SchemaHeader};
use sha2::{Digest, Sha256};

use crate::end::END_RECORD;
use crate::error::LogError;
use crate::header::{HEADER_RECORD, RUNS_RECORD};
use crate::library;
use crate::limits::DeclarationCount;
use crate::rewrite::{Packing, Rewriter};
use crate::source::LogSource;
use crate::stream::ReadOptions;
use crate::verdict::{Fault, verdict};
use crate::walk::{WalkItem, walk};

/// Calls `visit` for every piece of a log, which must be complete and written by Trabecula.
fn walk_whole(
    log: &dyn LogSource,
    visit: &mut dyn FnMut(WalkItem<'_>) -> Result<(), LogError>,
) -> Result<(), LogError> {
    let not_whole = |cause: &str| not_whole(log, cause);
    let (mut marked, mut headed) = (false, false);
    walk(log.open()?, log.path(), &mut |piece| match piece {
        WalkItem::Lost(lost) => Err(not_whole(&format!("damaged at byte {}: {}", lost.offset, lost.cause))),
        WalkItem::Cut { offset, .. } => Err(not_whole(&format!("truncated after byte {offset}"))),
        WalkItem::Metadata { name, entries } => {
            marked |= name == END_RECORD || name == RUNS_RECORD;
            headed |= name == HEADER_RECORD;
            visit(WalkItem::Metadata { name, entries })
        }
        other => visit(other),
    })?;
    match (marked, headed) {
        (true, _) => Ok(()),
        (false, true) => Err(not_whole("no end marker")),
        // Complete or not, another program wrote it, and repairing it would not turn it into a log.
        (false, false) => Err(LogError::NoHeader { path: log.path().into(), offset: 0 }),
    }
}

/// Rejects a run's log with a message that readers reject although every checksum is right, as another
/// program can write.
fn refuse_unreadable(log: &dyn LogSource) -> Result<(), LogError> {
    // A log of several runs has no messages to check here.
    let Ok(verdict) = verdict(log, ReadOptions { allow_other_layouts: true }) else { return Ok(()) };
    let damage = verdict.faults.iter().find_map(|fault| match fault {
        Fault::Damaged { offset, cause } => Some(format!("damaged at byte {offset}: {cause}")),
        _ => None,
    });
    damage.map_or(Ok(()), |cause| Err(not_whole(log, &cause)))
}

/// Returns a digest of all messages: topics, numbers, times and bytes in order.
fn digest(log: &dyn LogSource) -> Result<[u8; 32], LogError> {
    let (mut hasher, mut topics) = (Sha256::new(), BTreeMap::new());
    walk_whole(log, &mut |piece| {
        match piece {
            WalkItem::Channel(channel) => {
                topics.insert(channel.id, channel.topic);
            }
            WalkItem::Message { header, data } => {
                hasher.update(topics.get(&header.channel_id).map(String::as_str).unwrap_or_default());
                hasher.update(header.sequence.to_le_bytes());
                hasher.update(header.log_time.to_le_bytes());
                hasher.update((data.len() as u64).to_le_bytes());
                hasher.update(data);
            }
            _ => {}
        }
        Ok(())
    })?;
    Ok(hasher.finalize().into())
}

/// Writes a log to `out` with its chunks recompressed; errors name `path`.
///
/// # Errors
/// [`LogError::NotWhole`], and any error of the output.
pub fn compress<W: Write>(
    input: &dyn LogSource,
    out: W,
    path: &Path,
    packing: Packing,
) -> Result<W, LogError> {
    refuse_unreadable(input)?;
    let mut out = Rewriter::create(out, path, packing, library::of_rewritten(&[input]))?;
    walk_whole(input, &mut |piece| out.piece(piece))?;
    out.finish()
}

/// Checks that two logs contain the same messages in the same order. Any fault of the second is reported as
/// damage of `path`.
///
/// # Errors
/// [`LogError::NotWhole`] for the first, [`LogError::Damaged`] if the second cannot be read or differs.
pub fn check_packed(input: &dyn LogSource, packed: &dyn LogSource, path: &Path) -> Result<(), LogError> {
    let damaged = |cause| LogError::Damaged { path: path.into(), offset: 0, cause };
    let read_back = digest(packed).map_err(|error| damaged(error.without_path()))?;
    if digest(input)? != read_back {
        return Err(damaged("the compressed log does not read back identically".to_string()));
    }
    Ok(())
}

/// Prefix of one run's topics, attachments and metadata in a log of several runs.
fn prefix(run: usize) -> String {
    format!("run{run}/")
}

/// Concatenates complete logs into one log in `out`; errors name `path`. The first log's topics begin with
/// `/run1`, its attachments and metadata with `run1/`, and so on. Times are unchanged, so that a viewer shows
/// all runs on one axis. [`split`] undoes it.
///
/// # Errors
/// [`LogError::NotWhole`], [`LogError::SeveralRuns`], and any error of the output.
pub fn cat_files<W: Write>(inputs: &[&dyn LogSource], out: W, path: &Path) -> Result<W, LogError> {
    let mut out = Rewriter::create(out, path, Packing::RECORDED, library::of_rewritten(inputs))?;
    let runs = BTreeMap::from([("count".to_string(), inputs.len().to_string())]);
    out.metadata(RUNS_RECORD.to_string(), runs)?;
    for (index, input) in inputs.iter().enumerate() {
        refuse_unreadable(*input)?;
        let prefix = prefix(index + 1);
        out.begin_source(&format!("/{}", prefix.trim_end_matches('/')));
        walk_whole(*input, &mut |piece| match piece {
            WalkItem::Metadata { name, entries } if name == RUNS_RECORD => {
                let runs = entries.get("count").cloned().unwrap_or_default();
                Err(LogError::SeveralRuns { path: input.path().into(), runs })
            }
            WalkItem::Metadata { name, entries } => out.metadata(format!("{prefix}{name}"), entries),
            WalkItem::Attachment(mut found) => {
                found.name = format!("{prefix}{}", found.name);
                out.piece(WalkItem::Attachment(found))
            }
            other => out.piece(other),
        })?;
    }
    out.finish()
}

/// Where [`split`] writes the runs of a log, one at a time.
pub trait RunOutputs {
    /// The output of one run.
    type Output: Write;

    /// The path that error messages use for all outputs together.
    fn path(&self) -> &Path;

    /// The path that error messages use for the output of a run, numbered from 1.
    fn path_of(&self, run: usize) -> PathBuf;

    /// Opens the output of a run, numbered from 1.
    ///
    /// # Errors
    /// Any error of the output.
    fn begin(&mut self, run: usize) -> Result<Self::Output, LogError>;

    /// Closes the output of a complete run.
    ///
    /// # Errors
    /// Any error of the output.
    fn end(&mut self, output: Self::Output) -> Result<(), LogError>;
}

/// Rejects a log that is incomplete or does not declare several runs.
///
/// # Errors
/// [`LogError::NotWhole`], [`LogError::OneRun`].
pub fn check_holds_runs(input: &dyn LogSource) -> Result<(), LogError> {
    let mut marked = false;
    walk_whole(input, &mut |piece| {
        marked |= matches!(piece, WalkItem::Metadata { name, .. } if name == RUNS_RECORD);
        Ok(())
    })?;
    if marked { Ok(()) } else { Err(LogError::OneRun { path: input.path().into() }) }
}

/// Splits a log of several runs into one log per run. Returns the number of runs.
///
/// # Errors
/// [`LogError::NotWhole`], and any error of the outputs.
pub fn split(input: &dyn LogSource, outputs: &mut impl RunOutputs) -> Result<usize, LogError> {
    let mut split = Split::of(outputs, library::of_rewritten(&[input]));
    walk_whole(input, &mut |piece| split.take(piece))?;
    split.finish_run()?;
    match split.whole {
        0 => Err(not_whole(input, "it contains no run")),
        runs => Ok(runs),
    }
}

fn not_whole(input: &dyn LogSource, cause: &str) -> LogError {
    LogError::NotWhole { path: input.path().into(), cause: cause.to_owned() }
}

/// State of splitting a log of several runs into one log per run. The runs follow each other, so only one
/// output is open at a time.
struct Split<'o, O: RunOutputs> {
    outputs: &'o mut O,
    /// Value of the header's `library` field in each run's log.
    library: &'static str,
    /// Number of runs completed.
    whole: usize,
    /// The run being written.
    out: Option<Rewriter<O::Output>>,
    /// Schemas are declared once for all runs; each output declares them again with the first channel that
    /// needs them.
    schemas: BTreeMap<u16, (SchemaHeader, Vec<u8>)>,
    kept: DeclarationCount,
    chunk_is_ours: bool,
}

/// A run being written, and a name without the run's prefix.
struct InRun<'a, W: Write> {
    out: &'a mut Rewriter<W>,
    name: String,
}

impl<'o, O: RunOutputs> Split<'o, O> {
    fn of(outputs: &'o mut O, library: &'static str) -> Split<'o, O> {
        let (schemas, kept) = (BTreeMap::new(), DeclarationCount::default());
        Split { outputs, library, whole: 0, out: None, schemas, kept, chunk_is_ours: false }
    }

    fn take(&mut self, piece: WalkItem<'_>) -> Result<(), LogError> {
        match piece {
            WalkItem::Metadata { name, entries } => match self.run_of(&name)? {
                Some(InRun { out, name }) => out.metadata(name, entries),
                None => Ok(()),
            },
            WalkItem::Attachment(mut found) => match self.run_of(&found.name)? {
                Some(InRun { out, name }) => {
                    found.name = name;
                    out.attachment(&found)
                }
                None => Ok(()),
            },
            WalkItem::Schema { header, data } => {
                if !self.schemas.contains_key(&header.id) {
                    self.kept.schema(self.outputs.path(), &header, data.len())?;
                    self.schemas.insert(header.id, (header, data.to_vec()));
                }
                Ok(())
            }
            WalkItem::Channel(channel) => self.channel(channel),
            WalkItem::Message { header, data } => match &mut self.out {
                Some(out) if out.knows(header.channel_id) => {
                    self.chunk_is_ours = true;
                    out.piece(WalkItem::Message { header, data })
                }
                _ => Ok(()),
            },
            WalkItem::ChunkEnd => match &mut self.out {
                Some(out) if std::mem::take(&mut self.chunk_is_ours) => out.piece(WalkItem::ChunkEnd),
                _ => Ok(()),
            },
            _ => Ok(()),
        }
    }

    fn channel(&mut self, mut channel: Channel) -> Result<(), LogError> {
        let schema = self.schemas.get(&channel.schema_id).cloned();
        let Some(name) = channel.topic.strip_prefix('/') else { return Ok(()) };
        let Some(InRun { out, name: topic }) = self.run_of(name)? else { return Ok(()) };
        channel.topic = format!("/{topic}");
        if let Some((header, data)) = schema {
            out.piece(WalkItem::Schema { header, data: &data })?;
        }
        out.piece(WalkItem::Channel(channel))
    }

    /// Returns the run that a name of the joined log belongs to, or `None` if it belongs to no run. The first
    /// name of a run ends the previous run.
    fn run_of(&mut self, name: &str) -> Result<Option<InRun<'_, O::Output>>, LogError> {
        let run = |name: &str| name.strip_prefix("run")?.parse::<usize>().ok();
        let parts = name.split_once('/').and_then(|(first, rest)| Some((run(first)?, rest)));
        let Some((run, rest)) = parts else { return Ok(None) };
        let present = self.whole + usize::from(self.out.is_some());
        if run == present + 1 {
            self.finish_run()?;
            let (output, path) = (self.outputs.begin(run)?, self.outputs.path_of(run));
            self.out = Some(Rewriter::create(output, &path, Packing::RECORDED, self.library)?);
        } else if run != present {
            let cause = format!(
                "run {run} is interleaved with run {present}: `cat-files` writes them one after the other"
            );
            return Err(LogError::NotWhole { path: self.outputs.path().into(), cause });
        }
        Ok(self.out.as_mut().map(|out| InRun { out, name: rest.to_owned() }))
    }

    fn finish_run(&mut self) -> Result<(), LogError> {
        let Some(out) = self.out.take() else { return Ok(()) };
        self.whole += 1;
        self.outputs.end(out.finish()?)
    }
}
