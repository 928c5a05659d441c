//! `compress`, `cat-files`, `split` — whole logs, written again.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::BufReader;
use std::path::{Path, PathBuf};

use sha2::{Digest, Sha256};

use crate::end::END_RECORD;
use crate::error::LogError;
use crate::header::{HEADER_RECORD, RUNS_RECORD};
use crate::new_file::NewFile;
use crate::rewrite::{Packing, Rewriter};
use crate::walk::{Piece, walk};

/// Calls `visit` for every piece of a log that must be whole.
fn walk_whole(path: &Path, visit: &mut dyn FnMut(Piece<'_>) -> Result<(), LogError>) -> Result<(), LogError> {
    let file = File::open(path).map_err(|source| LogError::Open { path: path.into(), source })?;
    let not_whole = |cause: String| LogError::NotWhole { path: path.into(), cause };
    let mut marked = false;
    walk(BufReader::with_capacity(1 << 20, file), path, &mut |piece| match piece {
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
    let made = out.finish()?;
    if digest(input)? != digest(output)? {
        let cause = "the packed log reads back differently".to_string();
        return Err(LogError::Damaged { path: output.into(), offset: 0, cause });
    }
    let bytes = |path: &Path| {
        let found = std::fs::metadata(path).map(|metadata| metadata.len());
        found.map_err(|source| LogError::Open { path: path.into(), source })
    };
    let sizes = (bytes(input)?, bytes(output)?);
    made.keep();
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
    out.finish().map(NewFile::keep)
}

/// Makes a log of each run of a file of several: `run1.mcap`, `run2.mcap`, … in the folder `output`. Returns their
/// paths.
///
/// # Errors
/// [`LogError::NotWhole`], also if the file holds no several runs; [`LogError::Exists`]; what the disk says.
pub fn split(input: &Path, output: &Path) -> Result<Vec<PathBuf>, LogError> {
    let mut count = 0;
    walk_whole(input, &mut |piece| {
        if let Piece::Metadata { name, .. } = &piece
            && name.split_once('/').is_some_and(|(_, name)| name == HEADER_RECORD)
        {
            count += 1;
        }
        Ok(())
    })?;
    if count == 0 {
        let cause = "it holds one run, not several".to_string();
        return Err(LogError::NotWhole { path: input.into(), cause });
    }
    std::fs::create_dir_all(output).map_err(|source| LogError::Create { path: output.into(), source })?;
    let paths: Vec<PathBuf> = (1..=count).map(|run| output.join(format!("run{run}.mcap"))).collect();
    let made = paths.iter().enumerate().map(|(index, path)| split_one(input, path, &prefix(index + 1)));
    // All of them, or none.
    made.collect::<Result<Vec<_>, _>>()?.into_iter().for_each(NewFile::keep);
    Ok(paths)
}

fn split_one(input: &Path, output: &Path, prefix: &str) -> Result<NewFile, LogError> {
    let mut out = Rewriter::create(output, Packing::RECORDED)?;
    let topic_prefix = format!("/{}", prefix.trim_end_matches('/'));
    // A schema stands in the file once, for all runs; it is written with the first channel of this run that needs it.
    let mut schemas = BTreeMap::new();
    let mut chunk_is_ours = false;
    walk_whole(input, &mut |piece| match piece {
        Piece::Metadata { name, entries } => match name.strip_prefix(prefix) {
            Some(name) => out.metadata(name.to_owned(), entries),
            None => Ok(()),
        },
        Piece::Attachment(mut found) => match found.name.strip_prefix(prefix) {
            Some(name) => {
                found.name = name.to_owned();
                out.piece(Piece::Attachment(found))
            }
            None => Ok(()),
        },
        Piece::Schema { header, data } => {
            schemas.insert(header.id, (header, data.to_vec()));
            Ok(())
        }
        Piece::Channel(mut channel) => match channel.topic.strip_prefix(&topic_prefix) {
            Some(topic) if topic.starts_with('/') => {
                channel.topic = topic.to_owned();
                if let Some((header, data)) = schemas.get(&channel.schema_id) {
                    out.piece(Piece::Schema { header: header.clone(), data })?;
                }
                out.piece(Piece::Channel(channel))
            }
            _ => Ok(()),
        },
        Piece::Message { header, data } => {
            let ours = out.knows(header.channel_id);
            chunk_is_ours |= ours;
            if ours { out.piece(Piece::Message { header, data }) } else { Ok(()) }
        }
        Piece::ChunkEnd if !std::mem::take(&mut chunk_is_ours) => Ok(()),
        other => out.piece(other),
    })?;
    out.finish()
}
