//! Numbers as OBJ and MTL files write them, from bytes.

/// Powers of ten that an f64 holds exactly.
const POWERS: [f64; 23] = [
    1e0, 1e1, 1e2, 1e3, 1e4, 1e5, 1e6, 1e7, 1e8, 1e9, 1e10, 1e11, 1e12, 1e13, 1e14, 1e15, 1e16, 1e17, 1e18, 1e19, 1e20,
    1e21, 1e22,
];

/// The f32 nearest to a decimal number, ties to even: the same value as `str::parse` gives, which also takes over
/// where the short way is not exact. NaN and infinity parse; callers look at what is not finite.
pub(crate) fn float(token: &[u8]) -> Option<f32> {
    let parsed = || std::str::from_utf8(token).ok()?.parse().ok();
    short_float(token).or_else(parsed).or_else(|| is_printed_nan(token).then_some(f32::NAN))
}

/// What C libraries print for numbers that are none: `-nan(ind)`, `1.#QNAN`, `-1.#IND00`, `1.#INF`.
fn is_printed_nan(token: &[u8]) -> bool {
    let digits = token.strip_prefix(b"-").or(token.strip_prefix(b"+")).unwrap_or(token).to_ascii_lowercase();
    digits.starts_with(b"1.#") || digits.starts_with(b"nan(")
}

/// W. D. Clinger, *How to read floating point numbers accurately* (1990): up to 53 bits of digits and a power of ten
/// up to 22 are both exact in f64, so one operation rounds correctly. Rounding that to f32 is wrong only when
/// the f64 lies exactly between two f32, or below the normal ones.
fn short_float(token: &[u8]) -> Option<f32> {
    let (negative, digits) = match token.split_first()? {
        (b'-', rest) => (true, rest),
        (b'+', rest) => (false, rest),
        _ => (false, token),
    };
    let mut mantissa: u64 = 0;
    let mut exponent: i32 = 0;
    let mut seen = 0;
    let mut point = false;
    let mut at = 0;
    while let Some(&byte) = digits.get(at) {
        match byte {
            b'0'..=b'9' => {
                seen += 1;
                if seen > 19 {
                    return None;
                }
                mantissa = mantissa * 10 + u64::from(byte - b'0');
                exponent -= i32::from(point);
            }
            b'.' if !point => point = true,
            b'e' | b'E' => break,
            _ => return None,
        }
        at += 1;
    }
    if seen == 0 || mantissa >= 1 << 53 {
        return None;
    }
    if at < digits.len() {
        exponent += i32::try_from(integer(digits.get(at + 1..)?)?).ok().filter(|e| e.abs() < 1000)?;
    }
    let power = *POWERS.get(exponent.unsigned_abs() as usize)?;
    let value = if exponent < 0 { mantissa as f64 / power } else { mantissa as f64 * power };
    let halfway = value.to_bits() & 0x1FFF_FFFF == 0x1000_0000;
    if halfway || (value != 0.0 && !(f64::from(f32::MIN_POSITIVE)..=f64::from(f32::MAX)).contains(&value)) {
        return None;
    }
    Some(if negative { -value as f32 } else { value as f32 })
}

/// A whole number with an optional sign.
pub(crate) fn integer(token: &[u8]) -> Option<i64> {
    let (negative, digits) = match token.split_first()? {
        (b'-', rest) => (true, rest),
        (b'+', rest) => (false, rest),
        _ => (false, token),
    };
    if digits.is_empty() || digits.len() > 18 {
        return None;
    }
    let mut value: i64 = 0;
    for byte in digits {
        value = value * 10 + i64::from(byte.checked_sub(b'0').filter(|d| *d < 10)?);
    }
    Some(if negative { -value } else { value })
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn hard_cases_round_as_the_standard_library_does() {
        for text in [
            "0",
            "-0",
            "1.",
            ".5",
            "+2.5",
            "-0.477895",
            "16777217",
            "16777219",
            "1.00000005960464477539",
            "1.0000000596046448",
            "1e-45",
            "1e-46",
            "1.17549435e-38",
            "1.1754942e-38",
            "3.4028235e38",
            "3.4028236e38",
            "1e39",
            "1e999",
            "123456789012345678901234567890",
            "0.000000000000000000000000000001",
            "9007199254740993",
            "8388608.5",
            "8388609.5",
            "1e22",
            "1e23",
            "7e-10",
            "inf",
            "nan",
            "1.5E3",
            "1.5e+3",
        ] {
            let expected: f32 = text.parse().unwrap();
            assert_eq!(float(text.as_bytes()).unwrap().to_bits(), expected.to_bits(), "{text}");
        }
        for text in ["", "-", ".", "e5", "1e", "1e+", "1.2.3", "abc", "1,5", "0x10", "1f"] {
            assert_eq!(float(text.as_bytes()), None, "{text}");
        }
        assert_eq!((integer(b"-12"), integer(b"+7"), integer(b""), integer(b"1x")), (Some(-12), Some(7), None, None));
    }

    proptest! {
        #[test]
        fn any_float_in_any_spelling(bits: u32, places in 0_usize..12) {
            let value = f32::from_bits(bits);
            for text in [format!("{value}"), format!("{value:e}"), format!("{value:.places$}")] {
                let expected: f32 = text.parse().unwrap();
                let found = float(text.as_bytes()).unwrap();
                prop_assert!(found.to_bits() == expected.to_bits() || found.is_nan() && expected.is_nan(), "{}", text);
            }
        }

        #[test]
        fn any_digits(text in "[-+]?[0-9]{1,22}(\\.[0-9]{0,12})?(e-?[0-9]{1,3})?") {
            let expected: f32 = text.parse().unwrap();
            prop_assert_eq!(float(text.as_bytes()).unwrap().to_bits(), expected.to_bits());
        }
    }
}
