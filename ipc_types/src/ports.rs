//! Publishers and subscribers: messages are bytes in shared memory, checked against their layout at both
//! ends.

use core::marker::PhantomData;
use core::mem::MaybeUninit;

use iceoryx2::identifiers::UniquePublisherId;
use iceoryx2::port::publisher::Publisher as RawPublisher;
use iceoryx2::port::subscriber::Subscriber as RawSubscriber;
use iceoryx2::port::update_connections::UpdateConnections;
use iceoryx2::prelude::ipc;
use iceoryx2::sample::Sample;
use thiserror::Error;

use crate::identity::Guard;
use crate::messages::Part;
use crate::messages::layout::Message;
use crate::messages::services;
use crate::own::ProcessOwned;

/// Malformed messages that one call discards, so that a flood of them cannot stall the reader.
const REFUSED_AT_ONCE: usize = 64;
/// Size from which two threads copy a message: far above every per-tick message.
const TWO_THREADS_BYTES: usize = 32 << 20;
/// The same limit for other programs' messages on a part's service. Larger than any queue, because the part's
/// own messages behind them must not be delayed.
const MAX_FOREIGN_MESSAGES: usize = 1 << 14;

const _: () = {
    let mut i = 0;
    while i < services::ALL.len() {
        assert!(services::ALL[i].lossless_length < MAX_FOREIGN_MESSAGES);
        i += 1;
    }
};

/// Why a message could not be sent or received.
#[derive(Debug, Error)]
pub enum PortError {
    /// The volume did not arrive in time.
    #[error("the volume did not arrive within {limit_s} s; is the launcher running?")]
    NoVolume {
        /// Seconds waited.
        limit_s: u64,
    },
    /// The publisher could not get a free sample.
    #[error(
        "service `{service}`: could not allocate a sample of {bytes} bytes ({cause}); messages are limited \
         to {limit} bytes"
    )]
    Loan {
        /// Service name.
        service: String,
        /// Bytes requested.
        bytes: usize,
        /// Largest message of this publisher, bytes.
        limit: usize,
        /// iceoryx2's reason.
        cause: String,
    },
    /// The sample could not be delivered.
    #[error("service `{service}`: sending failed ({cause})")]
    Send {
        /// Service name.
        service: String,
        /// iceoryx2's reason.
        cause: String,
    },
    /// A connection to a publisher could not be read.
    #[error("service `{service}`: receiving failed ({cause})")]
    Receive {
        /// Service name.
        service: String,
        /// iceoryx2's reason.
        cause: String,
    },
    /// A message's length does not match its type and its own count.
    #[error("service `{service}`: received a message of {bytes} bytes, expected {expected}")]
    Length {
        /// Service name.
        service: String,
        /// Bytes received.
        bytes: usize,
        /// Expected length.
        expected: String,
    },
}

/// Sends messages of one type.
#[derive(Debug)]
pub struct Publisher<M> {
    port: ByteSender,
    message: PhantomData<M>,
}

impl<M: Message> Publisher<M> {
    pub(crate) fn new(port: ByteSender) -> Self {
        Publisher { port, message: PhantomData }
    }

    /// Sends a message of fixed length.
    pub fn send(&self, message: &M) -> Result<(), PortError> {
        self.port.send(&[message.as_bytes()])
    }

    /// Sends a message and the elements that follow it; the message's last field must be their count.
    pub fn send_with_tail(&self, message: &M, tail: &[u8]) -> Result<(), PortError> {
        self.port.send(&[message.as_bytes(), tail])
    }

    /// Sends the concatenation of `parts` as one message.
    pub fn send_parts(&self, parts: &[&[u8]]) -> Result<(), PortError> {
        self.port.send(parts)
    }

    /// Delivers the history to subscribers that joined since the last call or message.
    pub fn deliver_history(&self) -> Result<(), PortError> {
        self.port.deliver_history()
    }
}

/// A publisher of bytes. It knows no type of message, so that the transport's code is compiled once, in this
/// crate.
#[derive(Debug)]
pub(crate) struct ByteSender {
    raw: ProcessOwned<RawPublisher<ipc::Service, [u8], ()>>,
    name: String,
}

impl ByteSender {
    pub(crate) fn new(raw: RawPublisher<ipc::Service, [u8], ()>, name: String) -> Self {
        ByteSender { raw: ProcessOwned::new(raw), name }
    }

    fn send(&self, parts: &[&[u8]]) -> Result<(), PortError> {
        let bytes = parts.iter().map(|part| part.len()).sum();
        let mut sample = self.raw.loan_slice_uninit(bytes).map_err(|cause| PortError::Loan {
            service: self.name.clone(),
            bytes,
            limit: self.raw.initial_max_slice_len(),
            cause: format!("{cause:?}"),
        })?;
        let mut rest: &mut [MaybeUninit<u8>] = sample.payload_mut();
        for part in parts {
            let (head, tail) = rest.split_at_mut(part.len());
            copy(part, head);
            rest = tail;
        }
        // SAFETY: the sample is exactly as long as all parts together, and `copy` has written each part; if
        // one of its threads had died, the scope, and so this function, would have panicked.
        let sample = unsafe { sample.assume_init() };
        sample
            .send()
            .map_err(|cause| PortError::Send { service: self.name.clone(), cause: format!("{cause:?}") })?;
        Ok(())
    }

    fn deliver_history(&self) -> Result<(), PortError> {
        self.raw
            .update_connections()
            .map_err(|cause| PortError::Send { service: self.name.clone(), cause: format!("{cause:?}") })
    }
}

/// Copies bytes to a target of the same length. Uses two threads for a volume, because the kernel allocates
/// its pages on first use.
fn copy(bytes: &[u8], target: &mut [MaybeUninit<u8>]) {
    if bytes.len() >= TWO_THREADS_BYTES {
        let (first, second) = bytes.split_at(bytes.len() / 2);
        let (first_target, second_target) = target.split_at_mut(first.len());
        let is_shared = std::thread::scope(|scope| {
            let other = std::thread::Builder::new().spawn_scoped(scope, || copy_here(first, first_target));
            copy_here(second, second_target);
            other.is_ok()
        });
        if !is_shared {
            copy_here(first, first_target);
        }
    } else {
        copy_here(bytes, target);
    }
}

fn copy_here(bytes: &[u8], target: &mut [MaybeUninit<u8>]) {
    for (target, byte) in target.iter_mut().zip(bytes) {
        target.write(*byte);
    }
}

/// Receives messages of one type.
#[derive(Debug)]
pub struct Subscriber<M> {
    port: ByteReceiver,
    message: PhantomData<M>,
}

impl<M: Message> Subscriber<M> {
    pub(crate) fn new(port: ByteReceiver) -> Self {
        Subscriber { port, message: PhantomData }
    }

    /// Takes the oldest message in the queue, if any. Its bytes stay in shared memory until the return value
    /// is dropped.
    ///
    /// Returns an error for a message of the wrong length, which is taken off the queue. On a part's service,
    /// skips and counts messages from programs that are not that part ([`Subscriber::foreign_messages`]).
    pub fn receive(&self) -> Result<Option<ReceivedMessage<M>>, PortError> {
        let Some((sample, part)) = self.port.receive()? else { return Ok(None) };
        ReceivedMessage::new(sample, part, &self.port.name).map(Some)
    }

    /// Returns the number of messages so far from programs that are not the part that owns the service.
    pub fn foreign_messages(&self) -> u64 {
        self.port.guard.as_ref().map_or(0, Guard::foreign_messages)
    }

    /// Takes the oldest valid message, if any, on services that every client may write to. Messages of the
    /// wrong length go to `refused`, a limited number per call so that the caller is not held up.
    ///
    /// # Errors
    /// [`PortError::Receive`].
    pub fn receive_valid(
        &self,
        mut refused: impl FnMut(&PortError),
    ) -> Result<Option<ReceivedMessage<M>>, PortError> {
        for _ in 0..REFUSED_AT_ONCE {
            match self.receive() {
                Err(error @ PortError::Length { .. }) => refused(&error),
                other => return other,
            }
        }
        Ok(None)
    }

    /// Takes the newest message in the queue, if any, and drops the older ones.
    pub fn receive_newest(&self) -> Result<Option<ReceivedMessage<M>>, PortError> {
        let mut newest = None;
        while let Some(received) = self.receive()? {
            newest = Some(received);
        }
        Ok(newest)
    }

    /// Returns whether the queue holds a message.
    pub fn has_message(&self) -> bool {
        self.port.has_message()
    }
}

/// A subscriber of bytes, as [`ByteSender`] is a publisher.
#[derive(Debug)]
pub(crate) struct ByteReceiver {
    raw: ProcessOwned<RawSubscriber<ipc::Service, [u8], ()>>,
    name: String,
    /// Present on services that only the hub's parts may write to.
    guard: Option<Guard>,
}

impl ByteReceiver {
    pub(crate) fn new(
        raw: RawSubscriber<ipc::Service, [u8], ()>,
        name: String,
        guard: Option<Guard>,
    ) -> Self {
        ByteReceiver { raw: ProcessOwned::new(raw), name, guard }
    }

    /// The oldest message and the part that sent it, skipping those of programs that are not that part.
    fn receive(&self) -> Result<Option<(ByteSample, Option<Part>)>, PortError> {
        for _ in 0..MAX_FOREIGN_MESSAGES {
            let sample = self.raw.receive().map_err(|cause| PortError::Receive {
                service: self.name.clone(),
                cause: format!("{cause:?}"),
            })?;
            let Some(sample) = sample else { return Ok(None) };
            let part = match &self.guard {
                None => None,
                Some(guard) => match guard.part_of(sample.header().publisher_id()) {
                    None => continue,
                    known => known,
                },
            };
            return Ok(Some((ByteSample(ProcessOwned::new(sample)), part)));
        }
        Ok(None)
    }

    fn has_message(&self) -> bool {
        self.raw.has_samples().unwrap_or(true)
    }
}

/// A message's bytes in shared memory.
#[derive(Debug)]
pub(crate) struct ByteSample(ProcessOwned<Sample<ipc::Service, [u8], ()>>);

impl ByteSample {
    pub(crate) fn publisher_id(&self) -> UniquePublisherId {
        self.0.header().publisher_id()
    }

    fn payload(&self) -> &[u8] {
        self.0.payload()
    }
}

/// A message in shared memory. Copy it before deciding on its content: its writer is another process and
/// could change it.
#[derive(Debug)]
pub struct ReceivedMessage<M> {
    pub(crate) sample: ByteSample,
    part: Option<Part>,
    /// A copy, if the message is not aligned in shared memory.
    copy: Option<Box<M>>,
}

impl<M: Message> ReceivedMessage<M> {
    fn new(sample: ByteSample, part: Option<Part>, service: &str) -> Result<Self, PortError> {
        let bytes = sample.payload();
        M::DESCRIPTION.check_length(bytes).map_err(|expected| PortError::Length {
            service: service.to_owned(),
            bytes: bytes.len(),
            expected,
        })?;
        let copy = match M::ref_from_prefix(bytes) {
            Ok(_) => None,
            Err(_) => M::read_from_prefix(bytes).ok().map(|(message, _)| Box::new(message)),
        };
        Ok(ReceivedMessage { sample, part, copy })
    }

    /// Returns the part that sent it; `None` on services that every client may write to.
    pub fn part(&self) -> Option<Part> {
        self.part
    }

    /// Returns the message without its tail, without copying.
    pub fn message(&self) -> &M {
        match &self.copy {
            Some(copy) => copy,
            // SAFETY: `new` checked that the sample holds at least a message's bytes and, as there is no
            // copy, proved with `ref_from_prefix` that they form a valid `&M`. The sample keeps them in place
            // for as long as `self` lives, and no writer gets them before it is dropped.
            None => unsafe { &*self.sample.payload().as_ptr().cast::<M>() },
        }
    }

    /// Returns the bytes after the message (its tail, or a frame's image), without copying.
    pub fn tail(&self) -> &[u8] {
        &self.sample.payload()[M::DESCRIPTION.size..]
    }

    /// Returns all bytes, as in shared memory.
    pub fn bytes(&self) -> &[u8] {
        self.sample.payload()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_volume_is_copied_whole_by_two_threads() {
        for length in [0, 7, TWO_THREADS_BYTES - 1, TWO_THREADS_BYTES, TWO_THREADS_BYTES + 3] {
            let bytes: Vec<u8> = (0..length).map(|i| (i % 251) as u8).collect();
            let mut target = vec![MaybeUninit::new(255); length];
            copy(&bytes, &mut target);
            // SAFETY: every byte was initialised when the vector was created.
            let copied: Vec<u8> = target.iter().map(|byte| unsafe { byte.assume_init() }).collect();
            assert!(copied == bytes, "{length} bytes");
        }
    }
}
