//! OpenIGTLink streams from peers.

use openigtlink::{Body, Decoder, Error, HeaderVersion, Message, Point, PolyData, Transform};

const MOST: usize = 1 << 16;

/// Decodes a stream in pieces. A decoded message can be encoded again with the same meaning.
pub fn openigtlink(bytes: &[u8]) {
    let mut decoder = Decoder::new(MOST);
    for piece in bytes.chunks(997) {
        decoder.push(piece);
        loop {
            match decoder.next() {
                Ok(Some(message)) => again(&message),
                Ok(None) => break,
                Err(Error::HeaderVersion(_) | Error::TooLarge { .. }) => return,
                Err(_) => {}
            }
        }
    }
}

fn again(message: &Message) {
    // Names that are not ASCII are read but not written.
    let Ok(bytes) = message.encode(HeaderVersion::V2) else { return };
    let mut decoder = Decoder::new(bytes.len());
    decoder.push(&bytes);
    assert_eq!(decoder.next().as_ref(), Ok(&Some(message.clone())));
}

/// Seeds: a message of each type in both versions, and all in one stream.
pub fn seeds() -> Vec<Vec<u8>> {
    let rotation = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
    let point = |name: &str| Point {
        name: name.into(),
        group: String::new(),
        rgba: [255; 4],
        position_mm: [1.0, 2.0, 3.0],
        diameter_mm: 1.0,
        owner: String::new(),
    };
    let surface =
        PolyData { points_mm: vec![[0.0; 3], [1.0; 3]], lines: vec![vec![0, 1]], ..PolyData::default() };
    let bodies = [
        ("CArmToRAS", Body::Transform(Transform { rotation, translation_mm: [1.0, -2.0, 3.0] })),
        ("Plan", Body::Points(vec![point("Entry"), point("Target")])),
        ("Command", Body::Text("pause".into())),
        ("Tool", Body::PolyData(surface)),
    ];
    let mut seeds = Vec::new();
    for version in [HeaderVersion::V1, HeaderVersion::V2] {
        let one = |(device, body): &(&str, Body)| {
            Message::new(device, body.clone()).unwrap().encode(version).unwrap()
        };
        let each: Vec<Vec<u8>> = bodies.iter().map(one).collect();
        seeds.push(each.concat());
        seeds.extend(each);
    }
    seeds
}
