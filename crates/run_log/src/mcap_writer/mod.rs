//! An MCAP writer whose memory use does not grow with the file.
//!
//! The `mcap` crate's writer holds the index of every chunk in memory until the end: 0.7 MiB per minute for a
//! run with its timing lane. This one stores it in an [`IndexStore`] and copies it into the log's summary at
//! the end. Record layouts come from the crate, and the file matches the crate's own output byte for byte (a
//! test compares the two).

use std::collections::BTreeMap;
use std::io::{Read, Result, Seek, SeekFrom, Write};

use binrw::BinWrite;
use mcap::MAGIC;
use mcap::records::{
    AttachmentHeader, AttachmentIndex, Channel, ChunkIndex, DataEnd, Footer, Header, MessageHeader,
    MessageIndex, Metadata, MetadataIndex, SchemaHeader, Statistics, SummaryOffset, op,
};

mod chunk;
mod encoding;

use chunk::{Chunk, open};
use encoding::{Counted, begin, encode, encode_schema};

/// Stores the chunk indexes until the file ends: in memory, or in a file for a long run.
pub trait IndexStore: Read + Write + Seek + Send {}

impl<T: Read + Write + Seek + Send> IndexStore for T {}

/// A file being written, with LZ4-compressed chunks. [`finish`](McapWriter::finish) completes it.
pub(crate) struct McapWriter<W: Write> {
    out: Counted<W>,
    chunk: Option<Chunk>,
    schemas: Vec<(SchemaHeader, Vec<u8>)>,
    channels: Vec<Channel>,
    statistics: Statistics,
    chunk_indexes: Box<dyn IndexStore>,
    attachment_indexes: Vec<AttachmentIndex>,
    metadata_indexes: Vec<MetadataIndex>,
    /// A record's body, or bytes being copied from the index store to the output.
    scratch: Vec<u8>,
}

impl<W: Write> McapWriter<W> {
    /// Writes the start of the file. The chunk indexes go to `index`, which must be empty.
    pub fn create(out: W, index: Box<dyn IndexStore>, profile: &str, library: &str) -> Result<McapWriter<W>> {
        let mut writer = McapWriter {
            out: Counted { inner: out, position: 0, crc: crc32fast::Hasher::new() },
            chunk: None,
            schemas: Vec::new(),
            channels: Vec::new(),
            statistics: Statistics::default(),
            chunk_indexes: index,
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

    /// Declares a schema in the open chunk unless the same one is already declared; returns its number.
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

    /// Declares a channel in the open chunk; returns its number.
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

    /// Closes the open chunk and flushes the output.
    pub fn flush(&mut self) -> Result<()> {
        self.close_chunk()?;
        self.flush_output()
    }

    /// Flushes the output; the open chunk stays open.
    pub fn flush_output(&mut self) -> Result<()> {
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

    /// Returns the output as it is, without an end.
    pub fn into_output(self) -> W {
        self.out.inner
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
        // The checksum covers the footer up to the checksum field.
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

    /// Writes the groups of the summary; returns their offsets.
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

    /// Writes a group of records; skips an empty one.
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

#[cfg(test)]
mod tests {
    use std::borrow::Cow;

    use fastrand::Rng;
    use std::io::Cursor;

    use mcap::write::NoSeek;
    use mcap::{Attachment, Compression, WriteOptions, Writer};

    use super::*;

    /// Drives both writers with the same calls.
    struct Both {
        crates: Writer<NoSeek<Vec<u8>>>,
        own: McapWriter<Vec<u8>>,
    }

    impl Both {
        fn new() -> Both {
            let options = WriteOptions::new().library("library").profile("profile").chunk_size(None);
            let options = options.disable_seeking(true).compression(Some(Compression::Lz4));
            let own = McapWriter::create(Vec::new(), Box::new(Cursor::new(Vec::new())), "profile", "library")
                .unwrap();
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
            // Compressible and incompressible data, shorter and longer than an LZ4 block.
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
}
