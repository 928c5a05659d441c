//! The kernel's `struct input_event` (linux/input.h), as device nodes, pipes and recordings hold it.

/// Bytes of a record on a 64-bit kernel: seconds, microseconds, type, code, value.
pub(crate) const RECORD_BYTES: usize = 24;

/// Event types of linux/input-event-codes.h.
pub(crate) const EV_SYN: u16 = 0;
pub(crate) const EV_KEY: u16 = 1;
pub(crate) const EV_REL: u16 = 2;
pub(crate) const EV_ABS: u16 = 3;
/// Code of [`EV_SYN`]: the kernel's queue overflowed, and events were lost.
pub(crate) const SYN_DROPPED: u16 = 3;

/// An input event.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct InputEvent {
    /// Time of the event on the sender's clock; of the kernel: since 1970, UTC.
    pub(crate) time_s: f64,
    /// Its type (`EV_KEY` and so on).
    pub(crate) kind: u16,
    /// Code of the axis or button.
    pub(crate) code: u16,
    /// New value: of a button, 1 pressed, 0 released, 2 repeated by the keyboard.
    pub(crate) value: i32,
}

/// Splits a stream of bytes into events. Any bytes are events; it holds back an incomplete record.
#[derive(Debug, Default)]
pub(crate) struct EventReader {
    record: [u8; RECORD_BYTES],
    held_bytes: usize,
}

impl EventReader {
    /// Takes the next bytes of the stream and passes on the events that are complete.
    pub(crate) fn feed(&mut self, mut bytes: &[u8], mut event: impl FnMut(InputEvent)) {
        while !bytes.is_empty() {
            let count = bytes.len().min(RECORD_BYTES - self.held_bytes);
            self.record[self.held_bytes..self.held_bytes + count].copy_from_slice(&bytes[..count]);
            self.held_bytes += count;
            bytes = &bytes[count..];
            if self.held_bytes == RECORD_BYTES {
                self.held_bytes = 0;
                event(event_of(&self.record));
            }
        }
    }

    /// Bytes of the incomplete record.
    pub(crate) fn held_bytes(&self) -> usize {
        self.held_bytes
    }
}

fn event_of(record: &[u8; RECORD_BYTES]) -> InputEvent {
    fn part<const COUNT: usize>(record: &[u8; RECORD_BYTES], from: usize) -> [u8; COUNT] {
        core::array::from_fn(|index| record[from + index])
    }
    // A float cannot overflow, whatever the times are; it resolves today's to 0.3 us.
    let seconds = i64::from_ne_bytes(part(record, 0)) as f64;
    let microseconds = i64::from_ne_bytes(part(record, 8)) as f64;
    InputEvent {
        time_s: seconds + 1e-6 * microseconds,
        kind: u16::from_ne_bytes(part(record, 16)),
        code: u16::from_ne_bytes(part(record, 18)),
        value: i32::from_ne_bytes(part(record, 20)),
    }
}

#[cfg(test)]
pub(crate) fn record(time_us: i64, kind: u16, code: u16, value: i32) -> Vec<u8> {
    let (seconds, microseconds) = (time_us / 1_000_000, time_us % 1_000_000);
    let mut bytes = [seconds.to_ne_bytes(), microseconds.to_ne_bytes()].concat();
    bytes.extend(kind.to_ne_bytes());
    bytes.extend(code.to_ne_bytes());
    bytes.extend(value.to_ne_bytes());
    bytes
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn records_are_read_however_the_stream_is_cut() {
        let stream =
            [record(1_500_000, EV_ABS, 1, -32768), record(i64::MAX, EV_KEY, 0xffff, i32::MAX)].concat();
        for size in 1..=stream.len() {
            let (mut reader, mut events) = (EventReader::default(), Vec::new());
            stream.chunks(size).for_each(|bytes| reader.feed(bytes, |event| events.push(event)));
            assert_eq!(events[0], InputEvent { time_s: 1.5, kind: EV_ABS, code: 1, value: -32768 });
            assert_eq!((events.len(), events[1].value, reader.held_bytes()), (2, i32::MAX, 0));
        }
        let mut reader = EventReader::default();
        reader.feed(&stream[..30], |_| {});
        assert_eq!(reader.held_bytes(), 6);
    }
}
