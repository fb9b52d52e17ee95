//! Distribution: lists and records, failures with details.

use cara_core::distribution::failure::Failure;
use cara_core::distribution::function::{Definition, Signature, VariableSpec, VariableSpecs};
use cara_core::distribution::message;
use cara_core::distribution::nested::{Elements, Fields};
use cara_core::distribution::parameters::{Parameters, ParametersView, Value};
use cara_core::distribution::value::Type;
use cara_core::typed;

use crate::linkage::{drain, keep, show, unknown, unknown_slice, unknown_text};

fn parameters() -> &'static mut ParametersView {
    unknown::<Parameters<64>>()
}

entry!(nested_types, {
    let spec: &VariableSpec<'static> = unknown();
    keep((VariableSpec::flat(unknown_text(), *unknown(), *unknown()), spec.element(), unknown::<Type>().is_nested()));
    drain(spec.fields());
    keep(unknown::<VariableSpecs<'static>>().parameters_bytes());
});

entry!(nested_read, {
    keep((parameters().list(unknown_text()), parameters().record(unknown_text())));
    let (elements, fields): (&Elements<'static>, &Fields<'static>) = (unknown(), unknown());
    keep((elements.len(), elements.is_empty()));
    drain(elements.clone());
    drain(fields.clone());
    let value: &Value<'static> = unknown();
    drain(value.elements());
    drain(value.fields());
    keep((value.field(unknown_text()), value.spec()));
});

entry!(nested_written, {
    let parameters = parameters();
    keep(parameters.add_spec(*unknown()));
    keep(parameters.set_list(unknown_text(), |list| {
        list.push(*unknown::<i64>())?;
        list.push_list(|inner| inner.push(unknown_text()))?;
        list.push_record(|record| {
            record.set(unknown_text(), *unknown::<f64>())?;
            record.set_list(unknown_text(), |_| *unknown())?;
            record.set_record(unknown_text(), |_| *unknown())?;
            record.set_with(unknown_text(), |slot| slot.set(*unknown::<bool>()))
        })?;
        list.push_with(|slot| slot.list(|_| *unknown()))?;
        list.push_with(|slot| slot.record(|_| *unknown()))
    }));
    keep(parameters.set_record(unknown_text(), |_| *unknown()));
});

entry!(nested_typed, {
    let specs = unknown_slice::<VariableSpec<'static>>();
    keep((typed::element_bytes(*unknown()), typed::element::<16>(*unknown()), typed::on_stack(*unknown())));
    keep((typed::fields_bytes(specs), typed::fields::<64>(specs)));
    keep(typed::elements(*unknown()).map(|elements| elements.len()));
    keep(typed::optional(*unknown()));
    keep(typed::stream_of::<()>(unknown_text()));
});

entry!(details_declared, {
    let definition = unknown::<Definition>();
    keep(definition.clone().progress(parameters()));
    keep(definition.clone().failure(parameters()));
    let signature: &Signature<'static> = unknown();
    drain(signature.progress());
    drain(signature.failure());
});

entry!(failures, {
    let mut failure = Failure::new(*unknown(), unknown_text());
    keep(failure.values_mut().add_int(unknown_text(), *unknown()));
    keep((failure.code(), failure.error(), failure.values().len(), failure.is_cut()));
    keep(failure.text());
    show(&failure);
    keep(message::encode_progress(*unknown()));
});
