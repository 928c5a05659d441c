//! `trabecula log export`: a topic as a table, or the frames as pictures.

use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};

use clap::Args;
use output_file::Existing;
use recorder_proc::columns::{columns, description_of_topic, read_rows};
use recorder_proc::export::{Csv, Parquet, ending_of};
use recorder_proc::{FrameRecord, LogError, NewFile, ReadOptions, Verdict, frames, topics};

use super::{Out, concluded, failure};
use crate::commands::replay::log_path;
use crate::failure::Failure;
use crate::output::{NewFiles, refuse_existing};

/// Arguments of `log export`.
#[derive(Debug, Args)]
pub struct ExportArguments {
    /// Log file, or the folder of a run.
    log: PathBuf,
    /// A new `.csv` or `.parquet` file; with `--frames` a folder for the pictures.
    #[arg(short, long)]
    output: PathBuf,
    /// The topic of the table.
    #[arg(long, default_value = topics::STATE)]
    topic: String,
    /// A field of it (may be repeated); none for all. An array becomes a column an element.
    #[arg(long = "field")]
    fields: Vec<String>,
    /// First tick.
    #[arg(long, default_value_t = 0)]
    from: u64,
    /// Last tick, included.
    #[arg(long)]
    to: Option<u64>,
    /// A PNG a frame, 16 bits a pixel as recorded, instead of a table.
    #[arg(long, conflicts_with_all = ["fields"])]
    frames: bool,
}

/// Runs the command.
///
/// # Errors
/// Not a log, no such topic or field, another ending, an output that is there already (2); a log that is damaged,
/// behind the rows before the damage, or a full disk (1); one that has a gap, is cut or was not ended (3).
pub fn run(arguments: &ExportArguments, out: &mut Out<'_>) -> Result<(), Failure> {
    let log = log_path(&arguments.log);
    let (what, verdict) = match arguments.frames {
        true => pictures(&log, arguments)?,
        false => table(&log, arguments)?,
    };
    // Whoever closes the pipe has had enough.
    let _ = writeln!(out, "{}: {what}\n{}", arguments.output.display(), verdict.ending.describe());
    if !verdict.is_intact() {
        tell!("trabecula: {}: {verdict}", log.display());
    }
    concluded(out, verdict.exit_code())
}

fn table(log: &Path, arguments: &ExportArguments) -> Result<(String, Verdict), Failure> {
    let ending = ending_of(&arguments.output);
    if !matches!(ending.as_str(), "csv" | "parquet") {
        let given = arguments.output.display();
        return Err(Failure::bad_input(format!("--output is {given}, expected a .csv or .parquet file")));
    }
    refuse_existing(&[&arguments.output])?;
    let description = description_of_topic(log, &arguments.topic).map_err(failure)?;
    let columns = columns(description, &arguments.fields).map_err(failure)?;
    let (file, made) = NewFile::create(&arguments.output).map_err(failure)?;
    let file = BufWriter::new(file);
    let range = (arguments.from, arguments.to);
    // The rows before a damage are a whole table too.
    let (read, finished) = if ending == "csv" {
        let mut rows = Csv::new(file, &columns).map_err(failure)?;
        (read_rows(log, &arguments.topic, &columns, range, &mut rows), rows.finish())
    } else {
        let mut rows = Parquet::new(file, &columns).map_err(failure)?;
        (read_rows(log, &arguments.topic, &columns, range, &mut rows), rows.finish())
    };
    // What of it can be written is worth having.
    let kept = made.keep();
    let read = read.and_then(|end| finished.and(kept).map(|()| end));
    Ok((format!("{} columns of {}", columns.len() + 2, arguments.topic), read.map_err(failure)?))
}

fn pictures(log: &Path, arguments: &ExportArguments) -> Result<(String, Verdict), Failure> {
    let mut reader = frames(log, ReadOptions::default()).map_err(failure)?;
    let folder = &arguments.output;
    output_file::create_folder(folder)
        .map_err(|source| failure(LogError::Create { path: folder.clone(), source }))?;
    let (mut pictures, mut without) = (Vec::new(), 0_u64);
    let mut damage = None;
    while let Some(record) = reader.next() {
        let record = match record {
            Ok(record) => record,
            Err(LogError::Gap { .. }) if reader.go_on() => continue,
            Err(error) => {
                damage = Some(failure(error));
                break;
            }
        };
        let tick = record.frame.tick;
        if tick < arguments.from || arguments.to.is_some_and(|last| tick > last) {
            continue;
        }
        if record.image.is_none() {
            without += 1;
            continue;
        }
        let path = folder.join(format!("frame_{:06}_tick_{tick:08}.png", record.frame.sequence));
        // One that is there takes the others of this command away; those before a damage are kept.
        pictures.push(NewFiles::make(&[&path])?);
        write_png(&path, &record)?;
    }
    let written = pictures.len();
    pictures.into_iter().try_for_each(NewFiles::keep)?;
    if let Some(damage) = damage {
        return Err(damage);
    }
    Ok((format!("{written} pictures, {without} frames without one in the log"), reader.verdict()))
}

/// Grey, 16 bits, the values as recorded; PNG keeps the high byte first.
fn write_png(path: &Path, record: &FrameRecord) -> Result<(), Failure> {
    let Some(image) = record.image else { return Ok(()) };
    let swapped: Vec<u8> = record.pixels.chunks_exact(2).flat_map(|pixel| [pixel[1], pixel[0]]).collect();
    let mut bytes = Vec::new();
    let mut encoder = png::Encoder::new(&mut bytes, image.width, image.height);
    encoder.set_color(png::ColorType::Grayscale);
    encoder.set_depth(png::BitDepth::Sixteen);
    let write = encoder.write_header().and_then(|mut writer| {
        writer.write_image_data(&swapped)?;
        writer.finish()
    });
    write.map_err(|cause| Failure::failed(format!("{}: {cause}", path.display())))?;
    Ok(output_file::write(path, bytes, Existing::Replace)?)
}
