//! Damage, dealt by number: the same number deals the same.

use serde_json::{Value, json};

/// A small generator of random numbers (Steele, Lea and Flood 2014, *Fast splittable pseudorandom number generators*).
pub struct Random(u64);

impl Random {
    pub fn new(seed: u64) -> Self {
        Random(seed.wrapping_mul(0xD129_0B26_6CE9_8A4D))
    }
    pub fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let z = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ (z >> 31)
    }
    /// Below `end`, which counts as 1 where it is 0.
    pub fn below(&mut self, end: usize) -> usize {
        (self.next() % end.max(1) as u64) as usize
    }
    pub fn pick<'a, T>(&mut self, all: &'a [T]) -> &'a T {
        &all[self.below(all.len())]
    }
}

/// Words at which binary formats break.
const WORDS: [u32; 12] =
    [0, 1, 2, 3, 0x7F, 0xFF, 0xFFFF, 0x7FFF_FFFF, 0x8000_0000, 0xFFFF_FFFF, 0x7FC0_0000, 0x7F80_0000];

/// A few changes to bytes: bits, words, ranges cut, doubled or moved, an early end.
pub fn bytes(random: &mut Random, bytes: &mut Vec<u8>) {
    for _ in 0..1 + random.below(4) {
        if bytes.is_empty() {
            return;
        }
        let at = random.below(bytes.len());
        let end = (at + 1 + random.below(64)).min(bytes.len());
        match random.below(9) {
            0..3 => bytes[at] ^= 1 << random.below(8),
            3 => bytes[at] = random.next() as u8,
            4 | 5 => {
                let word = random.pick(&WORDS).to_le_bytes();
                // Most formats keep their words at multiples of four.
                bytes.iter_mut().skip(at & !3).zip(word).for_each(|(b, w)| *b = w);
            }
            6 => drop(bytes.drain(at..end)),
            7 => {
                let part = bytes[at..end].to_vec();
                let to = random.below(bytes.len());
                bytes.splice(to..to, part);
            }
            _ if random.below(4) == 0 => bytes.truncate(at),
            _ => bytes[at..end].fill(random.next() as u8),
        }
    }
}

const TOKENS: [&str; 30] = [
    "0",
    "-0",
    "1",
    "-1",
    "-2",
    "99999",
    "-99999",
    "4294967295",
    "4294967296",
    "-9223372036854775808",
    "1e308",
    "-1e38",
    "1e-45",
    "nan",
    "inf",
    "-inf",
    "1e",
    ".",
    "/",
    "//",
    "1//",
    "1/1/1/1",
    "1/-1/1",
    "\\",
    "#",
    "f",
    "v",
    "usemtl",
    "mtllib",
    "\u{fffd}",
];

/// A few changes to the words and lines of a text.
pub fn text(random: &mut Random, text: &str) -> String {
    let mut lines: Vec<String> = text.lines().map(str::to_owned).collect();
    for _ in 0..1 + random.below(4) {
        let (at, other) = (random.below(lines.len()), random.below(lines.len()));
        match random.below(8) {
            0..4 => {
                let mut words: Vec<&str> = lines[at].split(' ').collect();
                let word = random.below(words.len());
                match random.below(4) {
                    0 => drop(words.remove(word)),
                    1 => words.insert(word, random.pick::<&str>(&TOKENS)),
                    _ => words[word] = random.pick::<&str>(&TOKENS),
                }
                lines[at] = words.join(" ");
            }
            4 => drop(lines.remove(at)),
            5 => lines.swap(at, other),
            6 => lines.insert(other, lines[at].clone()),
            _ => {
                let line = lines[at].clone();
                lines[other].push_str([" ", "\\\r", "\t", "\0"][random.below(4)]);
                lines[other].push_str(&line);
            }
        }
        if lines.is_empty() {
            break;
        }
    }
    lines.join(if random.below(8) == 0 { "\r\n" } else { "\n" })
}

/// A few changes to a JSON document that keep it JSON: values replaced, removed, doubled, swapped.
pub fn document(random: &mut Random, root: &mut Value) {
    for _ in 0..1 + random.below(3) {
        let mut places = Vec::new();
        collect(root, &mut String::new(), &mut places);
        let place = random.pick(&places).clone();
        match random.below(8) {
            0 => remove(root, &place),
            1 => {
                let other = random.pick(&places).clone();
                let (a, b) = (root.pointer(&place).cloned(), root.pointer(&other).cloned());
                if let (Some(found), Some(value)) = (root.pointer_mut(&place), b) {
                    *found = value;
                }
                if let (Some(found), Some(value)) = (root.pointer_mut(&other), a) {
                    *found = value;
                }
            }
            2 => {
                if let Some((parent, _)) = place.rsplit_once('/')
                    && let Some(value) = root.pointer(&place).cloned()
                    && let Some(Value::Array(all)) = root.pointer_mut(parent)
                {
                    all.push(value);
                }
            }
            _ => {
                let Some(found) = root.pointer_mut(&place) else { continue };
                *found = replacement(random, found);
            }
        }
    }
}

fn replacement(random: &mut Random, found: &Value) -> Value {
    if let Some(number) = found.as_i64().filter(|_| random.below(2) == 0) {
        return json!(number.saturating_add([-1, 1, 2, 4, -4][random.below(5)]));
    }
    match random.below(20) {
        0 => json!(null),
        1 => json!(true),
        2 => json!(""),
        3 => json!([]),
        4 => json!({}),
        5 => json!(0),
        6 => json!(-1),
        7 => json!(0.5),
        8 => json!(1e300),
        9 => json!(u64::MAX),
        10 => json!(i64::MIN),
        11 => json!(0x7FFF_FFFF_u32),
        12 => json!(u32::MAX),
        13 => json!(1000),
        14 => json!("a/../../b"),
        15 => json!("x".repeat(300)),
        16 => json!([found]),
        17 => json!({ "index": found, "extensions": { "KHR_texture_transform": { "scale": [found, 1e30] } } }),
        18 => json!("data:;base64,AAAA"),
        _ => json!(random.below(12)),
    }
}

fn remove(root: &mut Value, place: &str) {
    let Some((parent, key)) = place.rsplit_once('/') else { return };
    match root.pointer_mut(parent) {
        Some(Value::Object(map)) => drop(map.remove(&key.replace("~1", "/").replace("~0", "~"))),
        Some(Value::Array(all)) => {
            if let Some(index) = key.parse().ok().filter(|i| *i < all.len()) {
                all.remove(index);
            }
        }
        _ => {}
    }
}

/// JSON pointers of all values.
fn collect(value: &Value, path: &mut String, places: &mut Vec<String>) {
    places.push(path.clone());
    let length = path.len();
    let mut visit = |key: &str, child: &Value| {
        path.push('/');
        path.push_str(&key.replace('~', "~0").replace('/', "~1"));
        collect(child, path, places);
        path.truncate(length);
    };
    match value {
        Value::Object(map) => map.iter().for_each(|(key, child)| visit(key, child)),
        Value::Array(all) => all.iter().enumerate().for_each(|(i, child)| visit(&i.to_string(), child)),
        _ => {}
    }
}
