//! What of a log's states changes from tick to tick, and how small they would be without loss in other forms than the recorder's.
//!
//! `cargo run --release -p run_log --example state_bytes -- RUN.mcap`

use std::collections::BTreeMap;
use std::error::Error;
use std::io::Write;

use run_log::{LogBytes, MessageStream, ReadOptions};

/// Ticks that a chunk of a log holds.
const CHUNK_TICKS: usize = 100;

type Outcome<T> = Result<T, Box<dyn Error>>;

fn main() -> Outcome<()> {
    let path = std::env::args().nth(1).ok_or("expected a run.mcap")?;
    let log = LogBytes::new(&path, std::fs::read(&path)?);
    let mut stream = MessageStream::open(&log, ReadOptions::default())?;
    let mut topics: BTreeMap<String, Topic> = BTreeMap::new();
    while let Some(message) = stream.next_message()? {
        let topic = topics.entry(message.topic.to_owned()).or_default();
        if topic.fields.is_empty() {
            let field = |field: &messages::layout::Field| (field.name, field.offset, field.size);
            topic.fields = message.description.fields.iter().map(field).collect();
        }
        topic.take(message.body)?;
    }
    println!(
        "{path}\n\nMB as they are, and after LZ4 at its fastest level in chunks of {CHUNK_TICKS} messages:\n"
    );
    println!(
        "{:<12}{:>9}{:>9}{:>9}{:>9}{:>11}{:>11}",
        "topic", "plain", "lz4", "by byte", "xor", "xor, byte", "same, zstd"
    );
    for (name, topic) in &mut topics {
        topic.end_chunk()?;
        let [plain, lz4, turned, xor, xor_turned, zstd] = topic.bytes.map(|bytes| bytes as f64 * 1e-6);
        println!("{name:<12}{plain:>9.2}{lz4:>9.2}{turned:>9.2}{xor:>9.2}{xor_turned:>11.2}{zstd:>11.2}");
    }
    if let Some(state) = topics.get("/state") {
        state.tell_changes();
    }
    Ok(())
}

/// The messages of one topic.
#[derive(Default)]
struct Topic {
    /// Name, offset and size.
    fields: Vec<(&'static str, usize, usize)>,
    last: Vec<u8>,
    /// Words of 8 bytes that differ from the last message's, and their bytes that do, by field.
    changed: BTreeMap<usize, [u64; 2]>,
    messages: u64,
    plain: Vec<Vec<u8>>,
    xor: Vec<Vec<u8>>,
    /// Plain, LZ4, turned and LZ4, XOR and LZ4, XOR, turned and LZ4, the same and zstd.
    bytes: [usize; 6],
}

impl Topic {
    fn take(&mut self, body: &[u8]) -> Outcome<()> {
        let is_first = self.last.len() != body.len();
        let xor =
            if is_first { body.to_vec() } else { body.iter().zip(&self.last).map(|(a, b)| a ^ b).collect() };
        if !is_first {
            self.messages += 1;
            for (index, (_, offset, size)) in self.fields.iter().enumerate() {
                let field = &xor[*offset..(*offset + *size).min(xor.len())];
                let counts = self.changed.entry(index).or_default();
                counts[0] += field.chunks(8).filter(|word| word.iter().any(|byte| *byte != 0)).count() as u64;
                counts[1] += field.iter().filter(|byte| **byte != 0).count() as u64;
            }
        }
        self.last = body.to_vec();
        self.plain.push(body.to_vec());
        self.xor.push(xor);
        if self.plain.len() == CHUNK_TICKS { self.end_chunk() } else { Ok(()) }
    }

    fn end_chunk(&mut self) -> Outcome<()> {
        let (plain, xor) = (std::mem::take(&mut self.plain), std::mem::take(&mut self.xor));
        let sizes = [
            plain.iter().map(Vec::len).sum(),
            lz4(&plain.concat())?,
            lz4(&turned(&plain))?,
            lz4(&xor.concat())?,
            lz4(&turned(&xor))?,
            zstd::encode_all(&turned(&xor)[..], 3)?.len(),
        ];
        self.bytes.iter_mut().zip(sizes).for_each(|(sum, size)| *sum += size);
        Ok(())
    }

    fn tell_changes(&self) {
        let of_all =
            |part: u64, bytes: usize| 100.0 * part as f64 / (self.messages.max(1) as f64 * bytes as f64);
        println!(
            "\nof /state, by field: bytes in a message, % of them in 8-byte words that change in a tick, % of them that change\n"
        );
        let mut all = [0, 0];
        for (index, counts) in &self.changed {
            let (name, _, size) = self.fields[*index];
            all.iter_mut().zip(counts).for_each(|(sum, count)| *sum += count);
            println!(
                "{name:<32}{size:>7}{:>8.1}{:>8.1}",
                of_all(8 * counts[0], size),
                of_all(counts[1], size)
            );
        }
        let size = self.last.len();
        println!("{:<32}{size:>7}{:>8.1}{:>8.1}", "all", of_all(8 * all[0], size), of_all(all[1], size));
    }
}

/// The first byte of every message, then the second of every message, and so on; messages of different lengths one after the other.
fn turned(messages: &[Vec<u8>]) -> Vec<u8> {
    let length = messages.first().map_or(0, Vec::len);
    if messages.iter().any(|message| message.len() != length) {
        return messages.concat();
    }
    (0..length).flat_map(|at| messages.iter().map(move |message| message[at])).collect()
}

fn lz4(bytes: &[u8]) -> Outcome<usize> {
    let mut encoder = lz4::EncoderBuilder::new().level(1).build(Vec::new())?;
    encoder.write_all(bytes)?;
    let (packed, outcome) = encoder.finish();
    outcome?;
    Ok(packed.len())
}
