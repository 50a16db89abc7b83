//! `intarsia openapi`: the OpenAPI document of the service.

use intarsia::error::Result;

/// Prints the document.
pub fn run() -> Result<()> {
    super::print(&intarsia::http::router::openapi_text())
}
