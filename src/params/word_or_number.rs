//! Parameters that are one of a few words, or a whole number in a range.

/// Declares such a parameter: an enum of words and a number, how its JSON is read and written, and its schema.
///
/// ```text
/// word_or_number! {
///     /// How far a walk goes.
///     pub enum Distance {
///         /// Until it is dark.
///         Auto = "auto",
///         /// As far as there is a way.
///         Free = "free";
///         /// Steps.
///         Steps(u32) in 1..=64,
///     }
/// }
/// ```
macro_rules! word_or_number {
    (
        $(#[$meta:meta])*
        pub enum $name:ident {
            $(
                $(#[doc = $word_doc:literal])+
                $variant:ident = $word:literal
            ),+;
            $(#[doc = $number_doc:literal])+
            $number:ident($type:ty) in $low:literal ..= $high:literal,
        }
    ) => {
        $(#[$meta])*
        #[derive(Debug, Clone, Copy, PartialEq, Eq)]
        pub enum $name {
            $(
                $(#[doc = $word_doc])+
                $variant,
            )+
            $(#[doc = $number_doc])+
            $number($type),
        }

        impl serde::Serialize for $name {
            fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
                match self {
                    $($name::$variant => serializer.serialize_str($word),)+
                    $name::$number(n) => n.serialize(serializer),
                }
            }
        }

        impl<'de> serde::Deserialize<'de> for $name {
            fn deserialize<D: serde::Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
                let value = serde_json::Value::deserialize(deserializer)?;
                match value.as_str() {
                    $(Some($word) => return Ok($name::$variant),)+
                    _ => {}
                }
                let number = value.as_u64().filter(|n| ($low..=$high).contains(n)).and_then(|n| n.try_into().ok());
                number.map($name::$number).ok_or_else(|| {
                    serde::de::Error::custom(concat!(
                        "must be ", $("\"", $word, "\" or ",)+ "a whole number in ", $low, "..=", $high
                    ))
                })
            }
        }

        impl utoipa::PartialSchema for $name {
            fn schema() -> utoipa::openapi::RefOr<utoipa::openapi::Schema> {
                use utoipa::openapi::schema::{ObjectBuilder, OneOfBuilder, Type};
                let word = ObjectBuilder::new().schema_type(Type::String).enum_values(Some([$($word),+]));
                let number =
                    ObjectBuilder::new().schema_type(Type::Integer).minimum(Some($low)).maximum(Some($high));
                let text = [$(concat!("\"", $word, "\":", $($word_doc),+),)+ concat!("A number:", $($number_doc),+)];
                OneOfBuilder::new().item(word).item(number).description(Some(text.join(" "))).into()
            }
        }

        impl utoipa::ToSchema for $name {}
    };
}
pub(crate) use word_or_number;
