//! Messages survive the wire, and damaged or hostile ones do no harm.

#![allow(clippy::unwrap_used, clippy::panic, reason = "helpers of tests fail the test")]

use openigtlink::{
    Body, Coordinates, Decoder, Error, HEADER_BYTES, HeaderVersion, Image, Message, Point, PolyData, Status,
    StatusCode, Timestamp, Transform,
};
use proptest::prelude::*;

const MOST: usize = 1 << 20;

fn one_of_each() -> Vec<Message> {
    let transform = Transform {
        rotation: [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]],
        translation_mm: [1.5, -2.0, 300.0],
    };
    let image = Image {
        coordinates: Coordinates::Ras,
        size: [3, 2, 1],
        axes_mm: [[0.4, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -0.4, 0.0]],
        centre_mm: [1.0, 2.0, 3.0],
        samples: vec![0, 1, 2, 40_000, 65_535, 5],
    };
    let point = Point {
        name: "Entry".into(),
        group: "Plan".into(),
        rgba: [255, 0, 0, 255],
        position_mm: [10.0, -20.0, 30.0],
        diameter_mm: 2.0,
        owner: String::new(),
    };
    let status = Status {
        code: StatusCode::AccessDenied,
        subcode: 7,
        error: "NO_TOKEN".into(),
        message: "no token was given".into(),
    };
    let surface = PolyData {
        points_mm: vec![[0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]],
        lines: vec![vec![0, 1], vec![1, 2, 0]],
        polygons: vec![vec![0, 1, 2]],
        ..PolyData::default()
    };
    let bodies = [
        Body::Transform(transform),
        Body::Image(image),
        Body::Points(vec![point.clone(), Point { name: "Target".into(), ..point }]),
        Body::Text("tip 1.2 mm from the target, 3°".into()),
        Body::Status(status),
        Body::PolyData(surface),
        Body::Other { kind: "GET_TRANS".into(), content: Vec::new() },
    ];
    let stamped = |body| Message {
        timestamp: Timestamp { seconds: 1_700_000_000, fraction: 1 << 31 },
        ..Message::new("Device", body).unwrap()
    };
    bodies.into_iter().map(stamped).collect()
}

#[test]
fn every_message_survives_the_wire_in_pieces_of_any_size() {
    for version in [HeaderVersion::V1, HeaderVersion::V2] {
        let sent = one_of_each();
        let stream: Vec<u8> = sent.iter().flat_map(|message| message.encode(version).unwrap()).collect();
        for piece in [1, 7, 58, 4096] {
            let mut decoder = Decoder::new(MOST);
            let mut came = Vec::new();
            for bytes in stream.chunks(piece) {
                decoder.push(bytes);
                while let Some(message) = decoder.next().unwrap() {
                    came.push(message);
                }
            }
            assert_eq!(came, sent, "{version:?} in pieces of {piece}");
            assert_eq!(decoder.version(), Some(version));
        }
    }
}

#[test]
fn a_flipped_bit_in_a_body_is_found_and_the_next_message_is_read() {
    let [first, second] = [0, 4].map(|index| one_of_each()[index].clone());
    let mut stream = first.encode(HeaderVersion::V1).unwrap();
    stream[HEADER_BYTES + 3] ^= 4;
    stream.extend(second.encode(HeaderVersion::V1).unwrap());
    let mut decoder = Decoder::new(MOST);
    decoder.push(&stream);
    assert!(matches!(decoder.next(), Err(Error::Checksum { .. })));
    assert_eq!(decoder.next(), Ok(Some(second)));
}

/// Regression: PLUS builds and scripts that compute no checksum send 0, which other receivers accept.
#[test]
fn a_message_without_a_checksum_is_read_and_noted() {
    for version in [HeaderVersion::V1, HeaderVersion::V2] {
        let sent = one_of_each()[0].clone();
        let mut stream = sent.encode(version).unwrap();
        let mut decoder = Decoder::new(MOST);
        decoder.push(&stream);
        assert_eq!(decoder.next(), Ok(Some(sent.clone())));
        assert!(!decoder.lacks_checksums());
        stream[HEADER_BYTES - 8..HEADER_BYTES].fill(0);
        decoder.push(&stream);
        assert_eq!(decoder.next(), Ok(Some(sent)));
        assert!(decoder.lacks_checksums());
    }
}

#[test]
fn a_huge_length_is_refused_before_memory_is_taken_for_it() {
    let mut bytes = one_of_each()[0].encode(HeaderVersion::V1).unwrap();
    bytes[42..50].copy_from_slice(&u64::MAX.to_be_bytes());
    let mut decoder = Decoder::new(MOST);
    decoder.push(&bytes);
    assert_eq!(decoder.next(), Err(Error::TooLarge { bytes: u64::MAX, most: MOST }));
}

#[test]
fn names_that_do_not_fit_are_refused_by_name() {
    let long = "a".repeat(21);
    assert!(matches!(Message::new(&long, Body::Text(String::new())), Err(Error::Text { most: 20, .. })));
    assert!(Message::new("größe", Body::Text(String::new())).is_err());
}

#[test]
fn what_is_no_number_is_refused() {
    let nan = Transform { rotation: [[f32::NAN; 3]; 3], translation_mm: [0.0; 3] };
    let bytes = Message::new("A", Body::Transform(nan)).unwrap().encode(HeaderVersion::V1).unwrap();
    let mut decoder = Decoder::new(MOST);
    decoder.push(&bytes);
    assert!(matches!(decoder.next(), Err(Error::Field { kind: "TRANSFORM", field: "rotation", .. })));
}

proptest! {
    #[test]
    fn any_bytes_are_read_or_refused(bytes in proptest::collection::vec(any::<u8>(), 0..600)) {
        let mut decoder = Decoder::new(1 << 12);
        decoder.push(&bytes);
        while let Ok(Some(_)) = decoder.next() {}
    }

    /// Bodies with a correct checksum but arbitrary content: only the readers of the types can reject them.
    #[test]
    fn any_content_of_any_type_is_read_or_refused(
        kind in prop::sample::select(vec!["TRANSFORM", "IMAGE", "POINT", "STRING", "STATUS", "POLYDATA"]),
        content in proptest::collection::vec(prop_oneof![Just(0_u8), Just(1), Just(2), Just(255), any::<u8>()], 0..400),
        extended in any::<bool>(),
    ) {
        let version = if extended { HeaderVersion::V2 } else { HeaderVersion::V1 };
        let body = Body::Other { kind: kind.into(), content };
        let mut decoder = Decoder::new(MOST);
        decoder.push(&Message::new("Any", body).unwrap().encode(version).unwrap());
        if let Ok(message) = decoder.next() {
            // Whatever was understood can be encoded again.
            let message = message.unwrap();
            let again = message.encode(version);
            prop_assert!(again.is_ok() || matches!(again, Err(Error::Text { .. })), "{message:?}: {again:?}");
        }
    }
}
