//! The OpenAPI document: the routes tell of themselves, here is what holds for all of them.

use serde_json::Value;
use utoipa::openapi::schema::{AdditionalProperties, SchemaType, Type};
use utoipa::openapi::security::{HttpAuthScheme, HttpBuilder, SecurityRequirement, SecurityScheme};
use utoipa::openapi::{
    Content, InfoBuilder, LicenseBuilder, OpenApi, OpenApiBuilder, Ref, RefOr, Response, ResponseBuilder, Schema,
    ServerBuilder,
};
use utoipa::{PartialSchema, ToResponse, ToSchema};

use super::artifacts::ArtifactBytes;
use super::problem::{Problem, status};
use crate::error::Code;

/// Name of the way to send a key.
const BEARER: &str = "bearer";

/// Media type of a [`Problem`].
const PROBLEM: &str = "application/problem+json";

/// The document without its routes.
pub(super) fn head() -> OpenApi {
    let info = InfoBuilder::new()
        .title("Intarsia")
        .version(env!("CARGO_PKG_VERSION"))
        .description(Some(
            "Refines the texture atlases of 3D models. Submit a model, follow its job, fetch the artifacts.",
        ))
        .license(Some(LicenseBuilder::new().name("MIT OR Apache-2.0").identifier(Some("MIT OR Apache-2.0")).build()))
        .build();
    let here = ServerBuilder::new().url("/").description(Some("The service that this document comes from")).build();
    OpenApiBuilder::new().info(info).servers(Some([here])).build()
}

/// Fills in what follows from the routes and the tables: every route may answer with any problem, problems have examples, codes their
/// status, and what the service tells is told whole.
pub(super) fn complete(mut document: OpenApi) -> OpenApi {
    for item in document.paths.paths.values_mut() {
        let operations = [&mut item.get, &mut item.post, &mut item.patch, &mut item.delete];
        for operation in operations.into_iter().flatten() {
            let responses = &mut operation.responses.responses;
            for (status, response) in responses.iter_mut() {
                exemplify(status, response);
            }
            responses.insert("default".to_owned(), Ref::from_response_name("Problem").into());
        }
    }
    let mut any = Content::new(Some(Ref::from_schema_name(Problem::name())));
    any.example = Some(example(Code::Internal, 500));
    let any = ResponseBuilder::new().description("Any other problem; `code` names it").content(PROBLEM, any).build();
    let components = document.components.get_or_insert_default();
    components.responses.insert("Problem".to_owned(), any.into());
    let (name, artifact) = ArtifactBytes::response();
    components.responses.insert(name.to_owned(), artifact);
    let bearer = HttpBuilder::new().scheme(HttpAuthScheme::Bearer).description(Some(
        "An API key, where the service was started with `--auth keys`. Each key has scopes: `submit`, `read`, `admin`.",
    ));
    components.add_security_scheme(BEARER, SecurityScheme::Http(bearer.build()));
    document.security = Some(vec![SecurityRequirement::default(), SecurityRequirement::new(BEARER, [""; 0])]);
    for (name, schema) in &mut components.schemas {
        let RefOr::T(Schema::Object(object)) = schema else { continue };
        // What is asked for is closed and has defaults; what is told has every key, with null where there is nothing to tell.
        let told = !matches!(object.additional_properties.as_deref(), Some(AdditionalProperties::FreeForm(false)));
        if told {
            object.required = object.properties.keys().cloned().collect();
        }
        if *name == Code::name() {
            object.description = Some(code_table());
        }
    }
    document
}

/// Gives the problem of a response its example, where it has none.
fn exemplify(status: &str, response: &mut RefOr<Response>) {
    let RefOr::T(response) = response else { return };
    let Some(RefOr::T(content)) = response.content.get_mut(PROBLEM) else { return };
    let number = status.parse().unwrap_or(500);
    let of_status = codes().into_iter().rfind(|code| self::status(*code).0.as_u16() == number);
    let code = of_status.unwrap_or(if number < 500 { Code::InvalidRequest } else { Code::Internal });
    content.example.get_or_insert_with(|| example(code, number));
}

fn example(code: Code, number: u16) -> Value {
    let problem = Problem { status: number, ..Problem::new(code, "What went wrong, in a sentence.") };
    serde_json::to_value(problem).unwrap_or_default()
}

/// Every code, as the schema of codes lists them.
fn codes() -> Vec<Code> {
    match Code::schema() {
        RefOr::T(Schema::Object(schema)) => {
            let names = schema.enum_values.into_iter().flatten();
            names.filter_map(|name| serde_json::from_value(name).ok()).collect()
        }
        _ => Vec::new(),
    }
}

/// What each code means, with the status of its problem.
fn code_table() -> String {
    let line = |code: Code| {
        let (status, title) = status(code);
        format!("* `{}` ({}): {title}", code.as_str(), status.as_u16())
    };
    format!(
        "Stable codes, each with the HTTP status of its problem:\n\n{}",
        codes().into_iter().map(line).collect::<Vec<_>>().join("\n")
    )
}

/// Bytes of any kind: a body, or a part of a form.
pub(super) struct Binary;

impl PartialSchema for Binary {
    fn schema() -> RefOr<Schema> {
        use utoipa::openapi::schema::{KnownFormat, ObjectBuilder, SchemaFormat};
        let string = ObjectBuilder::new().schema_type(SchemaType::Type(Type::String));
        string.format(Some(SchemaFormat::KnownFormat(KnownFormat::Binary))).into()
    }
}

impl ToSchema for Binary {}
