//! `repair` — turns a truncated or damaged log into a complete one, and reports what is missing.
//!
//! Every message in a chunk with a correct checksum is kept, with its number, time and place; the index and
//! the summary are rebuilt. If the chunk that declares a topic is damaged, the declaration comes from the old
//! summary or, if a run lane has lost that too, from the fixed order in which every run lane declares its
//! topics. Losses are counted from the messages' numbers and, if the end marker survives, from its counts;
//! both go into the new end marker, whose reason is `repaired`.

use std::collections::{BTreeMap, BTreeSet};
use std::io::{Read, Seek, Write};
use std::path::Path;

use foreign_text::{counted, foreign, foreign_line};
use messages::layout::{CDR_LITTLE_ENDIAN, Message};
use messages::{State, Tick};
use zerocopy::FromBytes;

use crate::end::{END_RECORD, EndMarker, EndReason, REPAIR_RECORD, TruncationPoint};
use crate::error::LogError;
use crate::header::{CALIBRATION_ATTACHMENT, HEADER_RECORD, SCENE_ATTACHMENT, other_layout};
use crate::index::Summary;
use crate::library;
use crate::limits::{DeclarationCount, MAX_REPORTED};
use crate::opening::Parts;
use crate::reader::LogReader;
use crate::records::AttachmentRecord;
use crate::rewrite::{Packing, Rewriter};
use crate::source::LogSource;
use crate::stream::ReadOptions;
use crate::topics::Topic;
use crate::verdict::{Fault, Verdict, verdict};
use crate::walk::{DamagedPiece, WalkItem, walk};

/// Messages of a topic found and lost.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct TopicRepair {
    /// Found.
    pub recovered: u64,
    /// Known to have been in the log and lost. After the last message found, only the end marker shows
    /// losses.
    pub lost: u64,
}

/// Result of a repair.
#[derive(Debug, Default)]
pub struct RepairReport {
    /// Messages by topic.
    pub topics: BTreeMap<String, TopicRepair>,
    /// The verdict on the input, as reported by every command; empty if it was intact.
    pub before: Verdict,
    /// The verdict on the result.
    pub after: Verdict,
    /// The first pieces of the file that were skipped.
    pub pieces: Vec<DamagedPiece>,
    /// Number of pieces beyond those listed.
    pub more_pieces: u64,
    /// Total size of the skipped pieces in bytes.
    pub left_out_bytes: u64,
    /// Messages skipped because their topic cannot be determined.
    pub undeclared: u64,
    /// Where the file is truncated, if it is.
    pub cut: Option<TruncationPoint>,
    /// The input's end marker.
    pub marker: Option<EndMarker>,
    /// Last tick up to which every tick is complete and can be replayed; `None` in the timing lane and
    /// without an initial state.
    pub complete_tick: Option<Tick>,
    /// Tick of the last state found.
    pub last_tick: Option<Tick>,
}

impl RepairReport {
    /// Returns true if the log was intact.
    pub fn was_whole(&self) -> bool {
        self.before.is_intact()
    }

    /// Writes the report as text.
    pub fn write(&self, out: &mut dyn Write) -> Result<(), LogError> {
        for DamagedPiece { offset, bytes, cause } in &self.pieces {
            writeln!(
                out,
                "skipped     {} from byte {offset}: {}",
                counted(bytes, "byte"),
                foreign_line(cause)
            )?;
        }
        if self.more_pieces > 0 {
            let (more, bytes) = (self.more_pieces, self.left_out_bytes);
            let pieces = counted(more, "more piece");
            writeln!(out, "skipped     {pieces}; {bytes} bytes in total")?;
        }
        if self.undeclared > 0 {
            writeln!(out, "skipped     {} of undeclared topics", counted(self.undeclared, "message"))?;
        }
        if let Some(TruncationPoint { offset, incomplete_bytes }) = self.cut {
            writeln!(
                out,
                "truncated   after byte {offset}, {incomplete_bytes} bytes of an incomplete record skipped"
            )?;
        }
        let before = match &self.marker {
            Some(marker) => format!("end marker: {}", foreign(&marker.reason.text())),
            None => "no end marker: what followed is unknown".to_string(),
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
        match self.was_whole() {
            true => writeln!(out, "the log was intact")?,
            false => writeln!(out, "it was      {}\nit is now   {}", self.before, self.after)?,
        }
        Ok(())
    }

    /// Reads both logs and fills in the verdicts and the last complete tick according to the readers, not
    /// according to the repair.
    ///
    /// # Errors
    /// The result cannot be read.
    pub fn judge(&mut self, input: &dyn LogSource, repaired: &dyn LogSource) -> Result<(), LogError> {
        let options = ReadOptions { allow_other_layouts: true };
        self.before = self.verdict_before(verdict(input, options));
        self.after = verdict(repaired, options)?;
        if let Ok(mut reader) = LogReader::open_with(repaired, options) {
            let complete = reader.by_ref().take_while(Result::is_ok).count() as u64;
            self.complete_tick = Some(reader.header().first_tick.saturating_add(complete));
        }
        Ok(())
    }

    /// Returns the verdict of the readers, plus faults that only a repair sees because it reads on where
    /// readers stop.
    fn verdict_before(&self, told: Result<Verdict, LogError>) -> Verdict {
        let damage = |offset, cause| Fault::Damaged { offset, cause };
        let mut before = told.unwrap_or_else(|error| {
            let faults = vec![damage(0, error.without_path())];
            Verdict { faults, ..Verdict::default() }
        });
        if before.is_intact()
            && let Some(piece) = self.pieces.first()
        {
            before.faults.push(damage(piece.offset, piece.cause.clone()));
        }
        before
    }

    /// Returns the lost messages by topic, without the topics that lost none.
    pub fn lost(&self) -> BTreeMap<String, u64> {
        let lost = self.topics.iter().filter(|(_, count)| count.lost > 0);
        lost.map(|(topic, count)| (topic.clone(), count.lost)).collect()
    }
}

/// A repair: first surveys the whole input, then writes the repaired copy.
pub struct Repair<'i> {
    input: &'i dyn LogSource,
    survey: Survey,
}

impl<'i> Repair<'i> {
    /// Surveys a log.
    ///
    /// # Errors
    /// [`LogError::NotMcap`], [`LogError::NoHeader`] if both copies of the header are lost,
    /// [`LogError::Read`].
    pub fn of(input: &'i dyn LogSource) -> Result<Repair<'i>, LogError> {
        Ok(Repair { input, survey: Survey::of(input.open()?, input.path())? })
    }

    /// Writes the repaired copy to `out`; errors name `path`. Returns the output and the report; call
    /// [`RepairReport::judge`] to fill in the verdicts once the result can be read.
    ///
    /// # Errors
    /// Any error of the input or the output.
    pub fn write<W: Write>(mut self, out: W, path: &Path) -> Result<(W, RepairReport), LogError> {
        let mut rewriter =
            Rewriter::create(out, path, Packing::RECORDED, library::of_rewritten(&[self.input]))?;
        rewriter.declare(std::mem::take(&mut self.survey.declared));
        write_repaired(self.input.open()?, self.input.path(), &self.survey, &mut rewriter)?;
        Ok((rewriter.finish()?, self.survey.report))
    }
}

/// Reports what a repair would find in a log from any source; errors name `path`. Does not replay the ticks.
///
/// # Errors
/// As [`Repair::of`].
pub fn survey<R: Read + Seek>(source: R, path: &Path) -> Result<RepairReport, LogError> {
    Survey::of(source, path).map(|survey| survey.report)
}

/// Contents of the input.
#[derive(Default)]
struct Survey {
    report: RepairReport,
    /// Topics of the channels, by their id in the input.
    topics: BTreeMap<u16, String>,
    schemas: BTreeSet<u16>,
    /// Declarations for channels whose own declaration is lost.
    declared: Summary,
    /// Whether a channel refers to a missing schema.
    lacks_schema: bool,
    /// Where the summary begins.
    data_end: Option<u64>,
    /// Whether the header is that of a run lane with this build's layouts that has never been repaired.
    is_our_run_lane: bool,
    last_state: Option<Box<State>>,
    /// A readable copy of the header, with its attachments.
    header: Option<(Vec<AttachmentRecord>, BTreeMap<String, String>)>,
    /// Attachments of the next header copy.
    attached: Vec<AttachmentRecord>,
    kept: DeclarationCount,
}

impl Survey {
    fn of<R: Read + Seek>(mut source: R, path: &Path) -> Result<Survey, LogError> {
        let mut survey = Survey::default();
        walk(&mut source, path, &mut |piece| survey.see(path, piece))?;
        if survey.header.is_none() {
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

    fn see(&mut self, path: &Path, piece: WalkItem<'_>) -> Result<(), LogError> {
        match piece {
            WalkItem::Metadata { name, entries } if name == HEADER_RECORD => {
                let attached = std::mem::take(&mut self.attached);
                let mut parts = Parts::default();
                attached.iter().for_each(|found| parts.take(found));
                if self.header.is_some() || parts.header(path, &entries).is_err() {
                    return Ok(());
                }
                let lane = entries.get("lane").map(String::as_str);
                self.is_our_run_lane = lane == Some("run") && other_layout(&entries).is_none();
                self.header = Some((attached, entries));
            }
            WalkItem::Metadata { name, entries } if name == END_RECORD => {
                // An unreadable marker is treated as missing.
                self.report.marker = EndMarker::from_metadata(path, &entries).ok();
            }
            // A repaired log may declare its topics in another order.
            WalkItem::Metadata { name, .. } if name == REPAIR_RECORD => self.is_our_run_lane = false,
            WalkItem::Attachment(found) if is_of_header(&found) && self.attached.len() < 2 => {
                self.attached.push(found);
            }
            WalkItem::Schema { header, .. } if self.schemas.insert(header.id) => {
                self.kept.schema(path, &header, 0)?;
            }
            WalkItem::Channel(channel) => {
                self.lacks_schema |= !self.schemas.contains(&channel.schema_id);
                if self.topics.get(&channel.id).is_none_or(|topic| *topic != channel.topic) {
                    self.kept.channel(path, &channel)?;
                }
                self.report.topics.entry(channel.topic.clone()).or_default();
                self.topics.insert(channel.id, channel.topic);
            }
            WalkItem::Message { header, data } => self.message(header.channel_id, header.sequence, data),
            WalkItem::DataEnd(offset) => self.data_end = Some(offset),
            WalkItem::Lost(lost) => {
                self.report.left_out_bytes += lost.bytes;
                match self.report.pieces.len() < MAX_REPORTED {
                    true => self.report.pieces.push(lost),
                    false => self.report.more_pieces += 1,
                }
            }
            WalkItem::Cut { offset, incomplete_bytes } => {
                self.report.cut = Some(TruncationPoint { offset, incomplete_bytes })
            }
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
        // A number that goes backwards is not a gap; reading the result will report it.
        count.lost += if jump < u32::MAX / 2 { u64::from(jump) } else { 0 };
        count.recovered += 1;
        if Topic::of_name(topic) == Some(Topic::State)
            && let Some(body) = data.strip_prefix(CDR_LITTLE_ENDIAN.as_slice())
            && body.len() == State::DESCRIPTION.size
            && let Ok(state) = State::read_from_bytes(body)
        {
            self.report.last_tick = Some(Tick(state.tick));
            self.last_state = Some(Box::new(state));
        }
    }

    /// Counts messages after the last one found, from the end marker's counts.
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

fn write_repaired<R: Read + Seek, W: Write>(
    source: R,
    path: &Path,
    survey: &Survey,
    out: &mut Rewriter<W>,
) -> Result<(), LogError> {
    let marker = survey.marker();
    write_header(survey, out)?;
    // Written at the start, so that readers know early that messages may be missing.
    out.metadata(REPAIR_RECORD.to_string(), repair_entries(&survey.report))?;
    let mut first = true;
    let is_rewritten = |name: &str| [HEADER_RECORD, END_RECORD, REPAIR_RECORD].contains(&name);
    walk(source, path, &mut |piece| match piece {
        WalkItem::Metadata { name, .. } if is_rewritten(&name) => Ok(()),
        WalkItem::Attachment(found) if is_of_header(&found) => Ok(()),
        WalkItem::ChunkEnd => {
            out.piece(WalkItem::ChunkEnd)?;
            if std::mem::take(&mut first) { write_header(survey, out) } else { Ok(()) }
        }
        other => out.piece(other),
    })?;
    if first {
        write_header(survey, out)?;
    }
    out.metadata(END_RECORD.to_string(), marker.to_metadata())
}

/// Writes a copy of the header; one goes at the start, the other after the first chunk.
fn write_header<W: Write>(survey: &Survey, out: &mut Rewriter<W>) -> Result<(), LogError> {
    let Some((attached, entries)) = &survey.header else { return Ok(()) };
    attached.iter().try_for_each(|found| out.attachment(found))?;
    out.metadata(HEADER_RECORD.to_string(), entries.clone())
}

fn is_of_header(found: &AttachmentRecord) -> bool {
    [SCENE_ATTACHMENT, CALIBRATION_ATTACHMENT].contains(&found.name.as_str())
}

fn repair_entries(report: &RepairReport) -> BTreeMap<String, String> {
    let mut entries: BTreeMap<String, String> =
        report.lost().into_iter().map(|(topic, n)| (format!("lost{topic}"), n.to_string())).collect();
    let left_out = report.left_out_bytes;
    let incomplete = report.cut.map_or(0, |cut| cut.incomplete_bytes);
    entries.insert("bytes_left_out".to_string(), (left_out + incomplete).to_string());
    entries
}
