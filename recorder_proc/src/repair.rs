//! `repair` — makes a whole log of a cut or damaged one, and says what is missing.
//!
//! Every message whose chunk's checksum is right is kept, with its number, its time and its place; the index and the
//! summary are written anew. If the chunk that declares a topic is damaged, the old summary declares it; in a run lane
//! that was cut besides, the order in which every run lane declares its topics. What is missing is counted by the
//! messages' numbers and, if the end marker is still there, by its counts; both stand in the new end marker, whose
//! reason is `repaired`.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::io::{BufReader, Read, Seek, Write};
use std::path::Path;

use foreign_text::{foreign, foreign_line};
use ipc_types::layout::{CDR_LITTLE_ENDIAN, Message};
use ipc_types::messages::State;
use zerocopy::FromBytes;

use crate::end::{END_RECORD, EndMarker, EndReason, REPAIR_RECORD};
use crate::error::LogError;
use crate::header::HEADER_RECORD;
use crate::index::Summary;
use crate::reader::{LogReader, ReadOptions};
use crate::rewrite::{Packing, Rewriter};
use crate::stream::other_layout;
use crate::topics;
pub use crate::walk::Lost;
use crate::walk::{Piece, walk};

/// Messages of a topic that were found and that were not.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct TopicRepair {
    /// Found.
    pub recovered: u64,
    /// Known to have been in the log and gone. Behind the last message found, only what the end marker tells.
    pub lost: u64,
}

/// What a repair found and left out.
#[derive(Debug, Default)]
pub struct RepairReport {
    /// Messages by topic.
    pub topics: BTreeMap<String, TopicRepair>,
    /// Pieces of the file that were left out.
    pub pieces: Vec<Lost>,
    /// Messages that nothing tells the topic of; left out.
    pub undeclared: u64,
    /// Where the file stops before its end: offset of the incomplete record, bytes of it.
    pub cut: Option<(u64, u64)>,
    /// The end marker that was there.
    pub marker: Option<EndMarker>,
    /// Last tick up to which every tick is complete, as a replay goes; none in the timing lane and without an initial
    /// state.
    pub complete_tick: Option<u64>,
    /// Last tick of any state.
    pub last_tick: Option<u64>,
}

impl RepairReport {
    /// True if nothing was wrong with the log.
    pub fn was_whole(&self) -> bool {
        self.pieces.is_empty() && self.undeclared == 0 && self.cut.is_none() && self.marker.is_some()
    }

    /// Writes the report for people.
    pub fn write(&self, out: &mut dyn Write) -> Result<(), LogError> {
        for Lost { offset, bytes, cause } in &self.pieces {
            writeln!(out, "left out    {bytes} bytes from byte {offset}: {}", foreign_line(cause))?;
        }
        if self.undeclared > 0 {
            writeln!(out, "left out    {} messages whose topic is declared nowhere", self.undeclared)?;
        }
        if let Some((offset, bytes)) = self.cut {
            writeln!(out, "cut         after byte {offset}, {bytes} bytes of an incomplete record left out")?;
        }
        let before = match &self.marker {
            Some(marker) => format!("end marker: {}", foreign(&marker.reason.text())),
            None => "no end marker: what may have followed is not known".to_string(),
        };
        writeln!(out, "before      {before}")?;
        for (topic, count) in &self.topics {
            let topic = foreign(topic);
            writeln!(out, "  {topic:<22} {:>10} messages kept {:>10} lost", count.recovered, count.lost)?;
        }
        match (self.complete_tick, self.last_tick) {
            (Some(complete), Some(last)) if complete < last => {
                writeln!(out, "ticks       complete up to {complete}; the last state is of tick {last}")?;
            }
            (Some(complete), _) => writeln!(out, "ticks       complete up to {complete}")?,
            (None, Some(last)) => {
                writeln!(out, "ticks       none complete; the last state is of tick {last}")?
            }
            (None, None) => {}
        }
        if self.was_whole() {
            writeln!(out, "nothing was wrong with it")?;
        }
        Ok(())
    }

    /// Lost messages by topic, without the topics that lost none.
    pub fn lost(&self) -> BTreeMap<String, u64> {
        let lost = self.topics.iter().filter(|(_, count)| count.lost > 0);
        lost.map(|(topic, count)| (topic.clone(), count.lost)).collect()
    }
}

/// Repairs `input` into the new file `output`. The input is not changed.
///
/// # Errors
/// [`LogError::NotMcap`], [`LogError::NoHeader`] if the header itself is gone, [`LogError::Exists`], and what the disk
/// says; then there is no output.
pub fn repair(input: &Path, output: &Path) -> Result<RepairReport, LogError> {
    let open = || -> Result<BufReader<File>, LogError> {
        let file = File::open(input).map_err(|source| LogError::Open { path: input.into(), source })?;
        Ok(BufReader::with_capacity(1 << 20, file))
    };
    let mut survey = Survey::of(open()?, input)?;
    let mut rewriter = Rewriter::create(output, Packing::RECORDED)?;
    rewriter.declare(std::mem::take(&mut survey.declared));
    write_repaired(open()?, input, &survey, &mut rewriter)?;
    rewriter.finish()?.keep();
    let mut report = survey.report;
    // As the result reads, not as it should.
    let options = ReadOptions { allow_other_layouts: true };
    if let Ok(mut reader) = LogReader::open_with(output, options) {
        let complete = reader.by_ref().take_while(Result::is_ok).count() as u64;
        report.complete_tick = Some(complete);
    }
    Ok(report)
}

/// What a repair would find in a log from any source; errors will name `path`. The ticks are not replayed.
///
/// # Errors
/// As [`repair`], without an output.
pub fn survey<R: Read + Seek>(source: R, path: &Path) -> Result<RepairReport, LogError> {
    Survey::of(source, path).map(|survey| survey.report)
}

/// What the input holds.
#[derive(Default)]
struct Survey {
    report: RepairReport,
    /// Topics of the channels, by their identifier in the input.
    topics: BTreeMap<u16, String>,
    schemas: BTreeSet<u16>,
    /// What declares the channels whose own declaration is gone.
    declared: Summary,
    /// Whether a channel is known of which there is no schema.
    lacks_schema: bool,
    /// Where the summary begins.
    data_end: Option<u64>,
    /// The header is a run lane's of this build's layouts, which no repair has written.
    is_our_run_lane: bool,
    last_state: Option<Box<State>>,
    has_header: bool,
}

impl Survey {
    fn of<R: Read + Seek>(mut source: R, path: &Path) -> Result<Survey, LogError> {
        let mut survey = Survey::default();
        walk(&mut source, path, &mut |piece| survey.see(path, piece))?;
        if !survey.has_header {
            return Err(LogError::NoHeader { path: path.into(), offset: 0 });
        }
        if (survey.report.undeclared > 0 || survey.lacks_schema)
            && let Some(declared) = survey.declarations(&mut source)
        {
            survey = Survey::default();
            survey.declare(declared);
            walk(&mut source, path, &mut |piece| survey.see(path, piece))?;
        }
        survey.count_behind_the_last();
        Ok(survey)
    }

    fn declarations<R: Read + Seek>(&self, source: &mut R) -> Option<Summary> {
        Summary::read(source, self.data_end).or_else(|| self.is_our_run_lane.then(Summary::of_run_lane))
    }

    fn declare(&mut self, declared: Summary) {
        for channel in declared.channels.values() {
            self.report.topics.entry(channel.topic.clone()).or_default();
            self.topics.insert(channel.id, channel.topic.clone());
        }
        self.schemas.extend(declared.schemas.keys());
        self.declared = declared;
    }

    fn see(&mut self, path: &Path, piece: Piece<'_>) -> Result<(), LogError> {
        match piece {
            Piece::Metadata { name, entries } if name == HEADER_RECORD => {
                self.has_header = true;
                let lane = entries.get("lane").map(String::as_str);
                self.is_our_run_lane = lane == Some("run") && other_layout(&entries).is_none();
            }
            Piece::Metadata { name, entries } if name == END_RECORD => {
                // One that cannot be read is as good as none.
                self.report.marker = EndMarker::from_metadata(path, &entries).ok();
            }
            // It may declare its topics in another order.
            Piece::Metadata { name, .. } if name == REPAIR_RECORD => self.is_our_run_lane = false,
            Piece::Schema { header, .. } => {
                self.schemas.insert(header.id);
            }
            Piece::Channel(channel) => {
                self.lacks_schema |= !self.schemas.contains(&channel.schema_id);
                self.report.topics.entry(channel.topic.clone()).or_default();
                self.topics.insert(channel.id, channel.topic);
            }
            Piece::Message { header, data } => self.message(header.channel_id, header.sequence, data),
            Piece::DataEnd(offset) => self.data_end = Some(offset),
            Piece::Lost(lost) => self.report.pieces.push(lost),
            Piece::Cut { offset, incomplete_bytes } => self.report.cut = Some((offset, incomplete_bytes)),
            _ => {}
        }
        Ok(())
    }

    fn message(&mut self, channel: u16, sequence: u32, data: &[u8]) {
        let Some(topic) = self.topics.get(&channel) else {
            self.report.undeclared += 1;
            return;
        };
        let count = self.report.topics.entry(topic.clone()).or_default();
        let jump = sequence.wrapping_sub((count.recovered + count.lost) as u32);
        // A number that goes back is no gap; the reader of the result will say what it thinks of it.
        count.lost += if jump < u32::MAX / 2 { u64::from(jump) } else { 0 };
        count.recovered += 1;
        if topic == topics::STATE
            && let Some(body) = data.strip_prefix(CDR_LITTLE_ENDIAN.as_slice())
            && body.len() == State::DESCRIPTION.size
            && let Ok(state) = State::read_from_bytes(body)
        {
            self.report.last_tick = Some(state.tick);
            self.last_state = Some(Box::new(state));
        }
    }

    /// Messages behind the last one found, by the counts of the end marker.
    fn count_behind_the_last(&mut self) {
        let Some(marker) = &self.report.marker else { return };
        for (topic, written) in &marker.counts {
            let count = self.report.topics.entry(topic.clone()).or_default();
            let written = written + marker.damaged.get(topic).copied().unwrap_or(0);
            count.lost = count.lost.max(written.saturating_sub(count.recovered));
        }
    }

    fn marker(&self) -> EndMarker {
        let before = self.report.marker.as_ref();
        let reason = match before.map(|marker| marker.reason.clone()) {
            Some(EndReason::Repaired(earlier)) => EndReason::Repaired(earlier),
            reason => EndReason::Repaired(reason.map(Box::new)),
        };
        let counts = self.report.topics.iter().map(|(topic, n)| (topic.clone(), n.recovered)).collect();
        EndMarker {
            reason,
            last_tick: self.report.last_tick.or(before.and_then(|marker| marker.last_tick)),
            hash: self.last_state.as_ref().map(|state| state.hash),
            counts,
            lost: before.map(|marker| marker.lost.clone()).unwrap_or_default(),
            damaged: self.report.lost(),
        }
    }
}

fn write_repaired<R: Read + Seek>(
    source: R,
    path: &Path,
    survey: &Survey,
    out: &mut Rewriter,
) -> Result<(), LogError> {
    let marker = survey.marker();
    let mut told = false;
    walk(source, path, &mut |piece| match piece {
        Piece::Metadata { name, .. } if name == END_RECORD || name == REPAIR_RECORD => Ok(()),
        Piece::Metadata { name, entries } if name == HEADER_RECORD && !told => {
            told = true;
            out.metadata(name, entries)?;
            // At the start, so that a reader of the messages knows that some may be missing.
            out.metadata(REPAIR_RECORD.to_string(), repair_entries(&survey.report))
        }
        other => out.piece(other),
    })?;
    out.metadata(END_RECORD.to_string(), marker.to_metadata())
}

fn repair_entries(report: &RepairReport) -> BTreeMap<String, String> {
    let mut entries: BTreeMap<String, String> =
        report.lost().into_iter().map(|(topic, n)| (format!("lost{topic}"), n.to_string())).collect();
    let left_out: u64 = report.pieces.iter().map(|piece| piece.bytes).sum();
    let (_, incomplete) = report.cut.unwrap_or((0, 0));
    entries.insert("bytes_left_out".to_string(), (left_out + incomplete).to_string());
    entries
}
