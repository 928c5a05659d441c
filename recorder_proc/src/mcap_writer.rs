//! A writer of MCAP files whose memory does not grow with the file.
//!
//! The `mcap` crate's writer holds the index of every chunk until the end: 0.7 MiB a minute for a run with its timing lane.
//! Here it goes to a file without a name beside the log, and from there into the log's summary. Record layouts are the
//! crate's, and so is every byte of the file (a test holds one against the other).

use std::collections::BTreeMap;
use std::io::{Cursor, Read, Result, Seek, SeekFrom, Write};
use std::path::Path;

use binrw::BinWrite;
use mcap::MAGIC;
use mcap::records::{
    AttachmentHeader, AttachmentIndex, Channel, ChunkHeader, ChunkIndex, DataEnd, Footer, Header,
    MessageHeader, MessageIndex, MessageIndexEntry, Metadata, MetadataIndex, SchemaHeader, Statistics,
    SummaryOffset, op,
};
use tempfile::{SpooledTempFile, spooled_tempfile_in};

/// Bytes of chunk indexes that are held before they go to the disk: those of about a minute.
const INDEX_BYTES: usize = 256 << 10;
const COMPRESSION: &str = "lz4";
/// Bytes of a message's fields before its data.
const MESSAGE_FIELDS: u64 = 2 + 4 + 8 + 8;

/// A file being written; its chunks are packed with LZ4. [`finish`](McapWriter::finish) makes it whole.
pub(crate) struct McapWriter<W: Write> {
    out: Counted<W>,
    chunk: Option<Chunk>,
    schemas: Vec<(SchemaHeader, Vec<u8>)>,
    channels: Vec<Channel>,
    statistics: Statistics,
    chunk_indexes: SpooledTempFile,
    attachment_indexes: Vec<AttachmentIndex>,
    metadata_indexes: Vec<MetadataIndex>,
    /// A record's body, or bytes on their way from one file to the other.
    scratch: Vec<u8>,
}

impl<W: Write> McapWriter<W> {
    /// Writes the file's beginning. What cannot be held in memory goes to a file without a name in `folder`.
    pub fn create(out: W, folder: &Path, profile: &str, library: &str) -> Result<McapWriter<W>> {
        let mut writer = McapWriter {
            out: Counted { inner: out, position: 0, crc: crc32fast::Hasher::new() },
            chunk: None,
            schemas: Vec::new(),
            channels: Vec::new(),
            statistics: Statistics::default(),
            chunk_indexes: spooled_tempfile_in(INDEX_BYTES, folder),
            attachment_indexes: Vec::new(),
            metadata_indexes: Vec::new(),
            scratch: Vec::new(),
        };
        writer.out.write_all(MAGIC)?;
        let header = Header { profile: profile.to_owned(), library: library.to_owned() };
        writer.record(op::HEADER, &header)?;
        Ok(writer)
    }

    /// Writes an attachment. The open chunk is closed first.
    pub fn attach(&mut self, name: &str, media_type: &str, data: &[u8]) -> Result<()> {
        self.close_chunk()?;
        let offset = self.out.position;
        let (name, media_type) = (name.to_owned(), media_type.to_owned());
        let header = AttachmentHeader { log_time: 0, create_time: 0, name, media_type };
        encode(&header, &mut self.scratch)?;
        self.scratch.extend_from_slice(&(data.len() as u64).to_le_bytes());
        let mut crc = crc32fast::Hasher::new();
        crc.update(&self.scratch);
        crc.update(data);
        self.out.begin(op::ATTACHMENT, (self.scratch.len() + data.len() + 4) as u64)?;
        self.out.write_all(&self.scratch)?;
        self.out.write_all(data)?;
        self.out.write_all(&crc.finalize().to_le_bytes())?;
        self.statistics.attachment_count += 1;
        self.attachment_indexes.push(AttachmentIndex {
            offset,
            length: self.out.position - offset,
            log_time: 0,
            create_time: 0,
            data_size: data.len() as u64,
            name: header.name,
            media_type: header.media_type,
        });
        Ok(())
    }

    /// Writes a metadata record. The open chunk is closed first.
    pub fn metadata(&mut self, name: &str, entries: BTreeMap<String, String>) -> Result<()> {
        self.close_chunk()?;
        let (offset, name) = (self.out.position, name.to_owned());
        self.record(op::METADATA, &Metadata { name: name.clone(), metadata: entries })?;
        self.statistics.metadata_count += 1;
        self.metadata_indexes.push(MetadataIndex { offset, length: self.out.position - offset, name });
        Ok(())
    }

    /// Declares a schema in the open chunk, unless there is the same already; its number.
    pub fn schema(&mut self, name: &str, encoding: &str, data: &[u8]) -> Result<u16> {
        let same = |(header, text): &&(SchemaHeader, Vec<u8>)| {
            header.name == name && header.encoding == encoding && text == data
        };
        if let Some((header, _)) = self.schemas.iter().find(same) {
            return Ok(header.id);
        }
        let id = self.schemas.len() as u16 + 1;
        let header = SchemaHeader { id, name: name.to_owned(), encoding: encoding.to_owned() };
        encode_schema(&header, data, &mut self.scratch)?;
        open(&mut self.chunk)?.record(op::SCHEMA, &self.scratch)?;
        self.schemas.push((header, data.to_owned()));
        Ok(id)
    }

    /// Declares a channel in the open chunk; its number.
    pub fn channel(
        &mut self,
        schema_id: u16,
        topic: &str,
        message_encoding: &str,
        metadata: BTreeMap<String, String>,
    ) -> Result<u16> {
        let id = self.channels.len() as u16 + 1;
        let (topic, message_encoding) = (topic.to_owned(), message_encoding.to_owned());
        let channel = Channel { id, schema_id, topic, message_encoding, metadata };
        encode(&channel, &mut self.scratch)?;
        open(&mut self.chunk)?.record(op::CHANNEL, &self.scratch)?;
        self.channels.push(channel);
        Ok(id)
    }

    /// Writes a message of a declared channel into the open chunk.
    pub fn message(&mut self, header: &MessageHeader, data: &[u8]) -> Result<()> {
        let statistics = &mut self.statistics;
        let time = header.log_time;
        if statistics.message_count == 0 {
            (statistics.message_start_time, statistics.message_end_time) = (time, time);
        }
        statistics.message_start_time = statistics.message_start_time.min(time);
        statistics.message_end_time = statistics.message_end_time.max(time);
        statistics.message_count += 1;
        *statistics.channel_message_counts.entry(header.channel_id).or_default() += 1;
        open(&mut self.chunk)?.message(header, data)
    }

    /// Closes the open chunk and hands its bytes on.
    pub fn flush(&mut self) -> Result<()> {
        self.close_chunk()?;
        self.out.inner.flush()
    }

    fn close_chunk(&mut self) -> Result<()> {
        let Some(chunk) = self.chunk.take() else { return Ok(()) };
        let (header, data, messages) = chunk.finish()?;
        let chunk_start_offset = self.out.position;
        encode(&header, &mut self.scratch)?;
        self.out.begin(op::CHUNK, (self.scratch.len() + data.len()) as u64)?;
        self.out.write_all(&self.scratch)?;
        self.out.write_all(&data)?;
        let chunk_length = self.out.position - chunk_start_offset;
        let (indexes_at, mut message_index_offsets) = (self.out.position, BTreeMap::new());
        for (channel_id, records) in messages {
            message_index_offsets.insert(channel_id, self.out.position);
            self.record(op::MESSAGE_INDEX, &MessageIndex { channel_id, records })?;
        }
        let index = ChunkIndex {
            message_start_time: header.message_start_time,
            message_end_time: header.message_end_time,
            chunk_start_offset,
            chunk_length,
            message_index_offsets,
            message_index_length: self.out.position - indexes_at,
            compression: header.compression,
            compressed_size: header.compressed_size,
            uncompressed_size: header.uncompressed_size,
        };
        self.statistics.chunk_count += 1;
        encode(&index, &mut self.scratch)?;
        begin(&mut self.chunk_indexes, op::CHUNK_INDEX, self.scratch.len() as u64)?;
        self.chunk_indexes.write_all(&self.scratch)
    }

    /// Writes the summary and the footer.
    pub fn finish(mut self) -> Result<W> {
        self.close_chunk()?;
        let data_section_crc = self.out.crc.clone().finalize();
        self.record(op::DATA_END, &DataEnd { data_section_crc })?;
        let summary_start = self.out.position;
        self.out.crc = crc32fast::Hasher::new();
        self.statistics.schema_count = self.schemas.len() as u16;
        self.statistics.channel_count = self.channels.len() as u32;
        let offsets = self.summary()?;
        let summary_offset_start = self.out.position;
        for offset in &offsets {
            self.record(op::SUMMARY_OFFSET, offset)?;
        }
        // The checksum covers the footer up to itself.
        encode(&Footer { summary_start, summary_offset_start, summary_crc: 0 }, &mut self.scratch)?;
        self.out.begin(op::FOOTER, self.scratch.len() as u64)?;
        self.scratch.truncate(16);
        self.out.write_all(&self.scratch)?;
        let summary_crc = self.out.crc.clone().finalize();
        self.out.write_all(&summary_crc.to_le_bytes())?;
        self.out.write_all(MAGIC)?;
        self.out.inner.flush()?;
        Ok(self.out.inner)
    }

    /// Writes the groups of the summary; where each lies.
    fn summary(&mut self) -> Result<Vec<SummaryOffset>> {
        let (schemas, channels) = (std::mem::take(&mut self.schemas), std::mem::take(&mut self.channels));
        let statistics = std::mem::take(&mut self.statistics);
        let attachments = std::mem::take(&mut self.attachment_indexes);
        let metadata = std::mem::take(&mut self.metadata_indexes);
        let mut offsets = Vec::new();
        self.group(op::SCHEMA, &mut offsets, |this| {
            schemas.iter().try_for_each(|(header, data)| {
                encode_schema(header, data, &mut this.scratch)?;
                this.out.begin(op::SCHEMA, this.scratch.len() as u64)?;
                this.out.write_all(&this.scratch)
            })
        })?;
        self.group(op::CHANNEL, &mut offsets, |this| this.records(op::CHANNEL, &channels))?;
        self.group(op::STATISTICS, &mut offsets, |this| this.record(op::STATISTICS, &statistics))?;
        self.group(op::CHUNK_INDEX, &mut offsets, Self::copy_chunk_indexes)?;
        self.group(op::ATTACHMENT_INDEX, &mut offsets, |this| {
            this.records(op::ATTACHMENT_INDEX, &attachments) //
        })?;
        self.group(op::METADATA_INDEX, &mut offsets, |this| this.records(op::METADATA_INDEX, &metadata))?;
        Ok(offsets)
    }

    /// Writes a group; one without records is none.
    fn group(
        &mut self,
        group_opcode: u8,
        offsets: &mut Vec<SummaryOffset>,
        write: impl FnOnce(&mut Self) -> Result<()>,
    ) -> Result<()> {
        let group_start = self.out.position;
        write(self)?;
        let group_length = self.out.position - group_start;
        if group_length > 0 {
            offsets.push(SummaryOffset { group_opcode, group_start, group_length });
        }
        Ok(())
    }

    fn copy_chunk_indexes(&mut self) -> Result<()> {
        self.chunk_indexes.seek(SeekFrom::Start(0))?;
        loop {
            self.scratch.clear();
            let count = Read::by_ref(&mut self.chunk_indexes).take(1 << 16).read_to_end(&mut self.scratch)?;
            if count == 0 {
                return Ok(());
            }
            self.out.write_all(&self.scratch)?;
        }
    }

    fn records<R>(&mut self, opcode: u8, records: &[R]) -> Result<()>
    where
        R: for<'a> BinWrite<Args<'a> = ()>,
    {
        records.iter().try_for_each(|record| self.record(opcode, record))
    }

    fn record<R>(&mut self, opcode: u8, record: &R) -> Result<()>
    where
        R: for<'a> BinWrite<Args<'a> = ()>,
    {
        encode(record, &mut self.scratch)?;
        self.out.begin(opcode, self.scratch.len() as u64)?;
        self.out.write_all(&self.scratch)
    }
}

/// Where a chunk's messages are, by channel.
type Messages = BTreeMap<u16, Vec<MessageIndexEntry>>;

/// A chunk being filled.
struct Chunk {
    packed: lz4::Encoder<Vec<u8>>,
    size: u64,
    crc: crc32fast::Hasher,
    bounds: Option<(u64, u64)>,
    messages: Messages,
}

/// The open chunk, a new one if there is none.
fn open(chunk: &mut Option<Chunk>) -> Result<&mut Chunk> {
    match chunk {
        Some(chunk) => Ok(chunk),
        none => Ok(none.insert(Chunk::new()?)),
    }
}

impl Chunk {
    fn new() -> Result<Chunk> {
        // The chunk's own checksum covers what a block's would.
        let no_block_checksum = lz4::liblz4::BlockChecksum::NoBlockChecksum;
        let packed =
            lz4::EncoderBuilder::new().level(0).block_checksum(no_block_checksum).build(Vec::new())?;
        Ok(Chunk { packed, size: 0, crc: crc32fast::Hasher::new(), bounds: None, messages: BTreeMap::new() })
    }

    fn write(&mut self, bytes: &[u8]) -> Result<()> {
        self.crc.update(bytes);
        self.size += bytes.len() as u64;
        self.packed.write_all(bytes)
    }

    fn record(&mut self, opcode: u8, body: &[u8]) -> Result<()> {
        self.write(&start_of(opcode, body.len() as u64))?;
        self.write(body)
    }

    fn message(&mut self, header: &MessageHeader, data: &[u8]) -> Result<()> {
        let log_time = header.log_time;
        let (first, last) = self.bounds.unwrap_or((log_time, log_time));
        self.bounds = Some((first.min(log_time), last.max(log_time)));
        let entry = MessageIndexEntry { log_time, offset: self.size };
        self.messages.entry(header.channel_id).or_default().push(entry);
        self.write(&start_of(op::MESSAGE, MESSAGE_FIELDS + data.len() as u64))?;
        let mut fields = [0; MESSAGE_FIELDS as usize];
        let mut place = Cursor::new(&mut fields[..]);
        header.write_le(&mut place).map_err(std::io::Error::other)?;
        self.write(&fields)?;
        self.write(data)
    }

    /// Its header, its packed bytes, and where its messages are.
    fn finish(self) -> Result<(ChunkHeader, Vec<u8>, Messages)> {
        let (data, ended) = self.packed.finish();
        ended?;
        let (message_start_time, message_end_time) = self.bounds.unwrap_or((0, 0));
        let header = ChunkHeader {
            message_start_time,
            message_end_time,
            uncompressed_size: self.size,
            uncompressed_crc: self.crc.finalize(),
            compression: COMPRESSION.to_owned(),
            compressed_size: data.len() as u64,
        };
        Ok((header, data, self.messages))
    }
}

/// Counts what is written and sums it up.
struct Counted<W> {
    inner: W,
    position: u64,
    crc: crc32fast::Hasher,
}

impl<W: Write> Counted<W> {
    fn write_all(&mut self, bytes: &[u8]) -> Result<()> {
        self.inner.write_all(bytes)?;
        self.crc.update(bytes);
        self.position += bytes.len() as u64;
        Ok(())
    }

    fn begin(&mut self, opcode: u8, length: u64) -> Result<()> {
        self.write_all(&start_of(opcode, length))
    }
}

fn begin(out: &mut impl Write, opcode: u8, length: u64) -> Result<()> {
    out.write_all(&start_of(opcode, length))
}

/// What stands before a record's body.
fn start_of(opcode: u8, length: u64) -> [u8; 9] {
    let mut start = [opcode; 9];
    start[1..].copy_from_slice(&length.to_le_bytes());
    start
}

/// A record's body by the crate's layout.
fn encode<R>(record: &R, body: &mut Vec<u8>) -> Result<()>
where
    R: for<'a> BinWrite<Args<'a> = ()>,
{
    body.clear();
    record.write_le(&mut Cursor::new(body)).map_err(std::io::Error::other)
}

fn encode_schema(header: &SchemaHeader, data: &[u8], body: &mut Vec<u8>) -> Result<()> {
    encode(header, body)?;
    body.extend_from_slice(&(data.len() as u32).to_le_bytes());
    body.extend_from_slice(data);
    Ok(())
}

#[cfg(test)]
mod tests {
    use std::borrow::Cow;

    use fastrand::Rng;
    use mcap::write::NoSeek;
    use mcap::{Attachment, Compression, WriteOptions, Writer};

    use super::*;

    /// The same calls to both.
    struct Both {
        crates: Writer<NoSeek<Vec<u8>>>,
        own: McapWriter<Vec<u8>>,
    }

    impl Both {
        fn new() -> Both {
            let options = WriteOptions::new().library("library").profile("profile").chunk_size(None);
            let options = options.disable_seeking(true).compression(Some(Compression::Lz4));
            let own = McapWriter::create(Vec::new(), Path::new("."), "profile", "library").unwrap();
            Both { crates: options.create(NoSeek::new(Vec::new())).unwrap(), own }
        }

        fn declare(&mut self, schema: &str, topic: &str) -> u16 {
            let data = schema.repeat(50).into_bytes();
            let metadata = BTreeMap::from([("layout".to_owned(), schema.to_owned())]);
            let id = self.crates.add_schema(schema, "ros2msg", &data).unwrap();
            assert_eq!(self.own.schema(schema, "ros2msg", &data).unwrap(), id);
            let channel = self.crates.add_channel(id, topic, "cdr", &metadata).unwrap();
            assert_eq!(self.own.channel(id, topic, "cdr", metadata).unwrap(), channel);
            channel
        }

        fn message(&mut self, random: &mut Rng, channels: u16, number: u32) {
            let (channel_id, log_time) = (1 + random.u16(..channels), random.u64(..1 << 40));
            let header = MessageHeader { channel_id, sequence: number, log_time, publish_time: log_time + 1 };
            // Compressible and not, shorter and longer than a block of LZ4.
            let most = [40, 9000, 300_000][random.usize(..3)];
            let mask = [0x03, 0xff][random.usize(..2)];
            let data: Vec<u8> = (0..random.usize(..most)).map(|_| random.u8(..) & mask).collect();
            self.crates.write_to_known_channel(&header, &data).unwrap();
            self.own.message(&header, &data).unwrap();
        }

        fn attach(&mut self, data: &[u8]) {
            let (name, media_type) = ("scene.toml".to_owned(), "application/toml".to_owned());
            self.own.attach(&name, &media_type, data).unwrap();
            let data = Cow::Borrowed(data);
            let attachment = Attachment { log_time: 0, create_time: 0, name, media_type, data };
            self.crates.attach(&attachment).unwrap();
        }

        fn metadata(&mut self, number: u32) {
            let metadata = BTreeMap::from([("number".to_owned(), number.to_string())]);
            self.own.metadata("end", metadata.clone()).unwrap();
            self.crates.write_metadata(&Metadata { name: "end".to_owned(), metadata }).unwrap();
        }

        fn compare(mut self) -> usize {
            self.crates.finish().unwrap();
            let (theirs, own) = (self.crates.into_inner().into_inner(), self.own.finish().unwrap());
            assert!(theirs == own, "{} and {} bytes", theirs.len(), own.len());
            own.len()
        }
    }

    #[test]
    fn every_byte_is_that_of_the_crates_writer() {
        assert!(Both::new().compare() > 100, "an empty file has its end");
        for seed in 0..12 {
            let (mut random, mut both) = (Rng::with_seed(seed), Both::new());
            both.attach(b"a scene");
            both.metadata(0);
            let mut channels = 0;
            for number in 0..120 {
                match random.u8(..12) {
                    0 => channels = both.declare(["A", "B", "C"][random.usize(..3)], &format!("/{number}")),
                    1 => {
                        both.crates.flush().unwrap();
                        both.own.flush().unwrap();
                    }
                    2 if random.bool() => both.metadata(number),
                    _ if channels > 0 => both.message(&mut random, channels, number),
                    _ => channels = both.declare("A", "/first"),
                }
            }
            both.metadata(9);
            both.compare();
        }
    }

    /// More indexes than are held in memory: the recorder grew by 0.7 MiB a minute.
    #[test]
    fn chunk_indexes_beyond_the_memory_go_to_the_disk_and_leave_no_file() {
        let folder = tempfile::tempdir().unwrap();
        let mut writer = McapWriter::create(Vec::new(), folder.path(), "profile", "library").unwrap();
        let schema = writer.schema("A", "ros2msg", b"text").unwrap();
        let channel_id = writer.channel(schema, "/a", "cdr", BTreeMap::new()).unwrap();
        let chunks = 4 * INDEX_BYTES as u64 / 100;
        for time in 0..chunks {
            let header = MessageHeader { channel_id, sequence: 0, log_time: time, publish_time: time };
            writer.message(&header, b"x").unwrap();
            writer.flush().unwrap();
        }
        assert!(writer.chunk_indexes.is_rolled());
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0, "it has no name");
        let bytes = writer.finish().unwrap();
        let summary = mcap::Summary::read(&bytes).unwrap().unwrap();
        assert_eq!(summary.chunk_indexes.len() as u64, chunks);
        let messages = mcap::MessageStream::new(&bytes).unwrap();
        let times: Vec<u64> = messages.map(|message| message.unwrap().log_time).collect();
        assert!(times.into_iter().eq(0..chunks));
    }
}
