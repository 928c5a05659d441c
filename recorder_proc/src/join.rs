//! `compress`, `cat-files`, `split` — whole logs, written again.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use mcap::records::{Channel, SchemaHeader};
use output_file::{WholeFile, keep_all};
use sha2::{Digest, Sha256};

use crate::end::END_RECORD;
use crate::error::LogError;
use crate::header::RUNS_RECORD;
use crate::limits::Declared;
use crate::records::open_log;
use crate::rewrite::{Packing, Rewriter};
use crate::walk::{Piece, walk};

/// Calls `visit` for every piece of a log that must be whole.
fn walk_whole(path: &Path, visit: &mut dyn FnMut(Piece<'_>) -> Result<(), LogError>) -> Result<(), LogError> {
    let file = open_log(path)?;
    let not_whole = |cause: String| LogError::NotWhole { path: path.into(), cause };
    let mut marked = false;
    walk(file, path, &mut |piece| match piece {
        Piece::Lost(lost) => Err(not_whole(format!("damaged at byte {}: {}", lost.offset, lost.cause))),
        Piece::Cut { offset, .. } => Err(not_whole(format!("cut after byte {offset}"))),
        Piece::Metadata { name, entries } => {
            marked |= name == END_RECORD || name == RUNS_RECORD;
            visit(Piece::Metadata { name, entries })
        }
        other => visit(other),
    })?;
    if marked { Ok(()) } else { Err(not_whole("no end marker".to_string())) }
}

/// Digest of all messages: topics, numbers, times and bytes in their order.
fn digest(path: &Path) -> Result<[u8; 32], LogError> {
    let (mut hasher, mut topics) = (Sha256::new(), BTreeMap::new());
    walk_whole(path, &mut |piece| {
        match piece {
            Piece::Channel(channel) => {
                topics.insert(channel.id, channel.topic);
            }
            Piece::Message { header, data } => {
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

/// Packs a log's chunks anew, into the new file `output`, and reads the result back: the same messages in the same
/// order. Returns the bytes before and after.
///
/// # Errors
/// [`LogError::NotWhole`], [`LogError::Exists`], what the disk says; then there is no output.
pub fn compress(input: &Path, output: &Path, packing: Packing) -> Result<(u64, u64), LogError> {
    let mut out = Rewriter::create(output, packing)?;
    walk_whole(input, &mut |piece| out.piece(piece))?;
    let packed = out.finish()?;
    let damaged = |cause| LogError::Damaged { path: output.into(), offset: 0, cause };
    let read_back = digest(&packed.draft()).map_err(|error| damaged(error.without_path()))?;
    if digest(input)? != read_back {
        return Err(damaged("the packed log reads back differently".to_string()));
    }
    let bytes = |path: &Path| {
        let found = std::fs::metadata(path).map(|metadata| metadata.len());
        found.map_err(|source| LogError::Open { path: path.into(), source })
    };
    let sizes = (bytes(input)?, bytes(&packed.draft())?);
    packed.keep()?;
    Ok(sizes)
}

/// What stands before the topics, attachments and metadata of a run in a file of several.
fn prefix(run: usize) -> String {
    format!("run{run}/")
}

/// Puts whole logs into one new file, run after run. The topics of the first begin with `/run1`, its attachments and
/// metadata with `run1/`; times stay as they are, so that a viewer shows the runs on one axis. [`split`] undoes it.
///
/// # Errors
/// [`LogError::NotWhole`] (also for a file of several runs), [`LogError::Exists`], what the disk says.
pub fn cat_files(inputs: &[PathBuf], output: &Path) -> Result<(), LogError> {
    let mut out = Rewriter::create(output, Packing::RECORDED)?;
    let runs = BTreeMap::from([("count".to_string(), inputs.len().to_string())]);
    out.metadata(RUNS_RECORD.to_string(), runs)?;
    for (index, input) in inputs.iter().enumerate() {
        let prefix = prefix(index + 1);
        out.begin_source(&format!("/{}", prefix.trim_end_matches('/')));
        walk_whole(input, &mut |piece| match piece {
            Piece::Metadata { name, entries } if name == RUNS_RECORD => {
                let runs = entries.get("count").cloned().unwrap_or_default();
                Err(LogError::SeveralRuns { path: input.clone(), runs })
            }
            Piece::Metadata { name, entries } => out.metadata(format!("{prefix}{name}"), entries),
            Piece::Attachment(mut found) => {
                found.name = format!("{prefix}{}", found.name);
                out.piece(Piece::Attachment(found))
            }
            other => out.piece(other),
        })?;
    }
    Ok(out.finish()?.keep()?)
}

/// Makes a log of each run of a file of several: `run1.mcap`, `run2.mcap`, … in the folder `output`. Returns their
/// paths.
///
/// # Errors
/// [`LogError::NotWhole`], also if the file holds no several runs; [`LogError::Exists`]; what the disk says.
pub fn split(input: &Path, output: &Path) -> Result<Vec<PathBuf>, LogError> {
    let not_whole = |cause: &str| LogError::NotWhole { path: input.into(), cause: cause.to_owned() };
    let mut marked = false;
    walk_whole(input, &mut |piece| {
        marked |= matches!(piece, Piece::Metadata { name, .. } if name == RUNS_RECORD);
        Ok(())
    })?;
    if !marked {
        return Err(not_whole("it holds one run, not several"));
    }
    output_file::create_folder(output).map_err(|source| LogError::Create { path: output.into(), source })?;
    let mut split = Split::of(output);
    walk_whole(input, &mut |piece| split.take(piece))?;
    split.finish_run()?;
    // All of them, or none.
    let Split { whole, .. } = split;
    if whole.is_empty() {
        return Err(not_whole("it holds no run"));
    }
    let paths = whole.iter().map(|file| file.path().to_owned()).collect();
    keep_all(whole)?;
    Ok(paths)
}

/// A file of several runs on its way into one file a run. They follow each other, so one is written at a time.
struct Split<'o> {
    folder: &'o Path,
    /// Files of the runs that are whole.
    whole: Vec<WholeFile>,
    /// The run that is being written.
    out: Option<Rewriter>,
    /// A schema stands in the file once, for all runs; each run declares it with its first channel that needs it.
    schemas: BTreeMap<u16, (SchemaHeader, Vec<u8>)>,
    kept: Declared,
    chunk_is_ours: bool,
}

impl<'o> Split<'o> {
    fn of(folder: &'o Path) -> Split<'o> {
        let (whole, schemas, kept) = (Vec::new(), BTreeMap::new(), Declared::default());
        Split { folder, whole, out: None, schemas, kept, chunk_is_ours: false }
    }

    fn take(&mut self, piece: Piece<'_>) -> Result<(), LogError> {
        match piece {
            Piece::Metadata { name, entries } => match self.run_of(&name)? {
                Some((out, name)) => out.metadata(name, entries),
                None => Ok(()),
            },
            Piece::Attachment(mut found) => match self.run_of(&found.name)? {
                Some((out, name)) => {
                    found.name = name;
                    out.attachment(&found)
                }
                None => Ok(()),
            },
            Piece::Schema { header, data } => {
                if !self.schemas.contains_key(&header.id) {
                    self.kept.schema(self.folder, &header, data.len())?;
                    self.schemas.insert(header.id, (header, data.to_vec()));
                }
                Ok(())
            }
            Piece::Channel(channel) => self.channel(channel),
            Piece::Message { header, data } => match &mut self.out {
                Some(out) if out.knows(header.channel_id) => {
                    self.chunk_is_ours = true;
                    out.piece(Piece::Message { header, data })
                }
                _ => Ok(()),
            },
            Piece::ChunkEnd => match &mut self.out {
                Some(out) if std::mem::take(&mut self.chunk_is_ours) => out.piece(Piece::ChunkEnd),
                _ => Ok(()),
            },
            _ => Ok(()),
        }
    }

    fn channel(&mut self, mut channel: Channel) -> Result<(), LogError> {
        let schema = self.schemas.get(&channel.schema_id).cloned();
        let Some(name) = channel.topic.strip_prefix('/') else { return Ok(()) };
        let Some((out, topic)) = self.run_of(name)? else { return Ok(()) };
        channel.topic = format!("/{topic}");
        if let Some((header, data)) = schema {
            out.piece(Piece::Schema { header, data: &data })?;
        }
        out.piece(Piece::Channel(channel))
    }

    /// The file of the run that a name of the joined file belongs to, and the name in it; none for what is no run's. A
    /// run that begins ends the one before it.
    fn run_of(&mut self, name: &str) -> Result<Option<(&mut Rewriter, String)>, LogError> {
        let run = |name: &str| name.strip_prefix("run")?.parse::<usize>().ok();
        let parts = name.split_once('/').and_then(|(first, rest)| Some((run(first)?, rest)));
        let Some((run, rest)) = parts else { return Ok(None) };
        let present = self.whole.len() + usize::from(self.out.is_some());
        if run == present + 1 {
            self.finish_run()?;
            let path = self.path(run);
            self.out = Some(Rewriter::create(&path, Packing::RECORDED)?);
        } else if run != present {
            let cause =
                format!("run {run} stands beside run {present}: `cat-files` writes them one after the other");
            return Err(LogError::NotWhole { path: self.folder.into(), cause });
        }
        Ok(self.out.as_mut().map(|out| (out, rest.to_owned())))
    }

    fn path(&self, run: usize) -> PathBuf {
        self.folder.join(format!("run{run}.mcap"))
    }

    fn finish_run(&mut self) -> Result<(), LogError> {
        let Some(out) = self.out.take() else { return Ok(()) };
        self.whole.push(out.finish()?);
        Ok(())
    }
}
