//! Adding data to a document: everything new goes to the end of buffer 0.

use gltf::accessor::Item;
use gltf::accessor::util::ItemIter;
use serde_json::{Map, Number, Value, json};

use super::ComponentType;
use super::accessor::RawAccessor;
use super::document::Document;

/// `bufferView.target` of vertex attributes.
pub const ARRAY_BUFFER: u32 = 34962;
/// `bufferView.target` of indices.
pub const ELEMENT_ARRAY_BUFFER: u32 = 34963;

impl Document {
    /// Appends bytes to buffer 0 (made where there is none), four-byte aligned, and a buffer view of them; gives the
    /// view's index. `target` is 34962 for vertex attributes, 34963 for indices, none for images and the rest.
    pub fn append_buffer_view(&mut self, bytes: &[u8], target: Option<u32>) -> usize {
        self.append_view(bytes, target, None)
    }

    /// Appends an accessor with its data; gives its index. Elements of vertex attributes (target 34962) are padded to
    /// four bytes, as glTF wants them. `bounds` adds `min` and `max`, which POSITION and animation inputs need.
    pub fn append_accessor(&mut self, raw: &RawAccessor, target: Option<u32>, bounds: bool) -> usize {
        let view = self.append_elements(raw, target);
        let mut object = json!({
            "bufferView": view,
            "componentType": raw.component_type,
            "count": raw.count,
            "type": raw.kind,
        });
        if raw.normalized {
            object["normalized"] = Value::Bool(true);
        }
        if bounds {
            set_bounds(&mut object, raw);
        }
        self.push("accessors", object)
    }

    /// Appends the elements of an accessor, padded as [`Self::append_accessor`] does; gives the index of their buffer view.
    pub(crate) fn append_elements(&mut self, raw: &RawAccessor, target: Option<u32>) -> usize {
        let size = raw.element_size;
        let padded = if target == Some(ARRAY_BUFFER) { size.next_multiple_of(4) } else { size };
        if padded == size || size == 0 {
            return self.append_view(&raw.data, target, None);
        }
        let mut data = Vec::with_capacity(raw.count * padded);
        for element in raw.data.chunks(size) {
            data.extend_from_slice(element);
            data.resize(data.len() + padded - size, 0);
        }
        self.append_view(&data, target, Some(padded))
    }

    /// Appends an object to an array of the document, made where there is none; gives its index.
    pub fn push(&mut self, key: &str, object: Value) -> usize {
        let array = self.array(key);
        array.push(object);
        array.len() - 1
    }

    /// Puts new contents into an image: its name, extras and file name stay, and the `mimeType` becomes `media_type`.
    /// Saving stores the bytes. Does nothing where there is no such image.
    pub fn set_image(&mut self, image: usize, bytes: Vec<u8>, media_type: &str) {
        let Some(object) = self.array("images").get_mut(image).and_then(Value::as_object_mut) else { return };
        object.shift_remove("bufferView");
        if object.get("uri").and_then(Value::as_str).is_some_and(super::uri::is_data) {
            object.shift_remove("uri");
        }
        object.insert("mimeType".to_owned(), Value::from(media_type));
        if self.images.len() <= image {
            self.images.resize(image + 1, None);
        }
        if let Some(slot) = self.images.get_mut(image) {
            *slot = Some(bytes);
        }
    }

    fn append_view(&mut self, bytes: &[u8], target: Option<u32>, stride: Option<usize>) -> usize {
        if self.buffers.is_empty() {
            self.buffers.push(Vec::new());
        }
        let mut offset = 0;
        let mut length = 0;
        if let Some(buffer) = self.buffers.first_mut() {
            offset = buffer.len().next_multiple_of(4);
            buffer.resize(offset, 0);
            buffer.extend_from_slice(bytes);
            length = buffer.len();
        }
        let buffers = self.array("buffers");
        if buffers.is_empty() {
            buffers.push(json!({}));
        }
        if let Some(object) = buffers.first_mut().and_then(Value::as_object_mut) {
            object.insert("byteLength".to_owned(), Value::from(length));
        }
        let mut view = json!({ "buffer": 0, "byteOffset": offset, "byteLength": bytes.len() });
        if let Some(stride) = stride {
            view["byteStride"] = Value::from(stride);
        }
        if let Some(target) = target {
            view["target"] = Value::from(target);
        }
        self.push("bufferViews", view)
    }

    /// An array of the document. `load` has seen that it is none other; what is not one is replaced.
    fn array(&mut self, key: &str) -> &mut Vec<Value> {
        if !self.json.is_object() {
            self.json = Value::Object(Map::new());
        }
        let entry = &mut self.json[key];
        if !entry.is_array() {
            *entry = Value::Array(Vec::new());
        }
        match entry {
            Value::Array(array) => array,
            _ => unreachable!("it was made an array above"),
        }
    }
}

/// Writes `min` and `max` of the elements into their accessor's object, as the stored components (normalised integers as
/// integers); nothing where there are none.
pub(crate) fn set_bounds(object: &mut Value, raw: &RawAccessor) {
    match raw.component_type {
        _ if raw.count == 0 => {}
        ComponentType::I8 => set_bounds_of::<i8>(object, raw),
        ComponentType::U8 => set_bounds_of::<u8>(object, raw),
        ComponentType::I16 => set_bounds_of::<i16>(object, raw),
        ComponentType::U16 => set_bounds_of::<u16>(object, raw),
        ComponentType::U32 => set_bounds_of::<u32>(object, raw),
        ComponentType::F32 => set_bounds_of::<f32>(object, raw),
    }
}

fn set_bounds_of<T: Item + Into<f64>>(object: &mut Value, raw: &RawAccessor) {
    let mut bounds = vec![(f64::INFINITY, f64::NEG_INFINITY); raw.kind.multiplicity()];
    for element in raw.data.chunks_exact(raw.element_size) {
        for ((low, high), value) in bounds.iter_mut().zip(ItemIter::<T>::new(element, size_of::<T>())) {
            let value: f64 = value.into();
            if !value.is_finite() {
                continue;
            }
            (*low, *high) = (low.min(value), high.max(value));
        }
    }
    let number = |value: f64| match raw.component_type {
        ComponentType::F32 => Number::from_f64(value).map_or(Value::from(0), Value::Number),
        _ => Value::from(value as i64),
    };
    object["min"] = bounds.iter().map(|(low, _)| number(*low)).collect();
    object["max"] = bounds.iter().map(|(_, high)| number(*high)).collect();
}
