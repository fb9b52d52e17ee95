//! Distribution: parameters, functions, lists, identities.

use cara_core::distribution::function::{Attributes, Definition, Signature, VariableSpec};
use cara_core::distribution::function_list::{Entry, FunctionList, TheirFunctionList};
use cara_core::distribution::identity::Identity;
use cara_core::distribution::parameters::{Parameters, ParametersView, Value};
use cara_core::distribution::value::{Target, Type};
use cara_core::storage::Lent;
use cara_core::typed::{self, Field};

use crate::linkage::{drain, keep, show, unknown, unknown_slice, unknown_text};

type Small = Parameters<64>;

fn parameters() -> &'static mut ParametersView {
    unknown::<Small>()
}

entry!(parameters_made, {
    keep((Parameters::new(), Small::sized()));
});

entry!(parameters_added, {
    let parameters = parameters();
    keep(parameters.add(unknown_text(), *unknown(), *unknown()));
    keep(parameters.add_int(unknown_text(), *unknown()));
    keep(parameters.add_float(unknown_text(), *unknown()));
    keep(parameters.add_bool(unknown_text(), *unknown()));
    keep(parameters.add_string(unknown_text(), *unknown()));
    keep(parameters.add_bytes(unknown_text(), *unknown()));
});

entry!(parameters_set, {
    let parameters = parameters();
    keep(parameters.set_value(unknown_text(), *unknown::<[i64; 2]>()));
    keep(parameters.set_value(unknown_text(), unknown_slice::<f64>() as &[f64]));
    keep(parameters.set_value(unknown_text(), *unknown::<u16>()));
    keep(parameters.set_value(unknown_text(), *unknown::<bool>()));
    keep(parameters.set_value(unknown_text(), *unknown::<f32>()));
    keep(parameters.set_value(unknown_text(), unknown_text()));
    keep(parameters.set_value(unknown_text(), unknown_slice::<u8>() as &[u8]));
    keep(parameters.copy_from(unknown::<Small>()));
});

entry!(parameters_read, {
    let parameters = parameters();
    keep(parameters.variable::<[i64; 2]>(unknown_text()));
    keep(parameters.variable::<i8>(unknown_text()));
    keep(parameters.variable::<f32>(unknown_text()));
    keep(parameters.variable::<[bool; 3]>(unknown_text()));
    keep(parameters.variable::<&str>(unknown_text()));
    keep(parameters.variable::<&[u8]>(unknown_text()));
    keep(parameters.variable_into(unknown_text(), unknown_slice::<u32>()));
    keep(parameters.value(unknown_text()));
    drain(parameters.iter());
    keep((parameters.remaining(), parameters.len(), parameters.is_empty()));
    keep((unknown::<Small>().as_view(), unknown::<Small>().as_mut_view()));
    parameters.clear();
});

entry!(parameters_placed, {
    let parameters = parameters();
    keep(parameters.lay_out(*unknown::<Signature<'static>>()));
    keep(parameters.value_of(*unknown()));
});

entry!(typed_signatures, {
    let (arguments, results) = (unknown_slice::<VariableSpec<'static>>(), unknown_slice::<VariableSpec<'static>>());
    let (progress, fails) = (unknown_slice::<VariableSpec<'static>>(), unknown_slice::<VariableSpec<'static>>());
    let (help, units) = (unknown_text(), unknown_slice::<typed::Units>());
    let declared = typed::Declared { arguments, results, progress, fails, help, units };
    keep(declared.encoded_bytes(unknown_text()));
    keep(typed::parameters_bytes(arguments, results));
    keep(typed::place(&typed::places_of_results(arguments, results), *unknown()));
    if let Ok(encoded) = typed::Encoded::<64>::new(unknown_text(), declared) {
        keep(encoded.signature().name());
    }
    if let Err(mismatch) = typed::Mismatch::check(*unknown::<Signature<'static>>(), *unknown::<Signature<'static>>()) {
        show(&mismatch);
    }
});

entry!(typed_values, {
    let parameters = parameters();
    keep(typed::argument::<u16>(parameters, *unknown()));
    keep(typed::argument::<[f32; 3]>(parameters, *unknown()));
    keep(typed::argument::<typed::heapless::String<8>>(parameters, *unknown()));
    keep(typed::argument::<typed::heapless::Vec<u8, 8>>(parameters, *unknown()));
    keep(typed::borrowed::<&str>(parameters, *unknown()));
    keep(typed::refused(*unknown()));
    if let Ok(slot) = parameters.slot_of(*unknown()) {
        keep(unknown::<typed::heapless::String<8>>().to_field(slot));
    }
    if let Ok(slot) = parameters.slot_of(*unknown()) {
        keep(unknown::<typed::heapless::Vec<u8, 8>>().to_field(slot));
    }
    if let Ok(slot) = parameters.slot_of(*unknown()) {
        keep(unknown::<[i8; 3]>().to_field(slot));
    }
});

entry!(values, {
    let value: &Value<'static> = unknown();
    drain(value.ints());
    drain(value.floats());
    drain(value.bools());
    keep((value.text(), value.raw(), value.kind(), value.size()));
    let target: &Target<'static> = unknown();
    keep((target.kind(), target.size()));
});

entry!(types, {
    let kind: &Type = unknown();
    keep((kind.word(), kind.is_fixed(), kind.width(), kind.bytes_of(*unknown())));
});

entry!(definitions, {
    keep(Definition::new(unknown_text()));
    keep(Definition::parse(unknown_text()));
    keep(Definition::stream(unknown_text()));
    let definition = unknown::<Definition>();
    keep(definition.clone().arguments(parameters()));
    keep(definition.clone().results(parameters()));
    keep(definition.clone().help(unknown_text()));
    keep(definition.clone().unit(unknown_text(), unknown_text()));
    keep((definition.name(), definition.as_bytes(), definition.signature()));
});

entry!(signatures, {
    if let Ok(signature) = Signature::decode(unknown_slice()) {
        drain(signature.arguments());
        drain(signature.results());
        keep(signature.arguments().named(unknown_text()));
        keep((signature.name(), signature.as_bytes(), signature.parameters_bytes()));
        keep(Signature::of_checked(signature.as_bytes()));
        keep(signature.to_definition());
        keep((signature.help(), signature.unit_of(unknown_text())));
        signature.units().for_each(|unit| keep(unit));
    }
});

entry!(attributes, {
    keep((Attributes::decode(unknown_slice()), unknown::<Attributes>().encode()));
    show(*unknown::<Attributes>());
    keep(unknown::<Attributes>().is_urgent(*unknown()));
    keep(unknown::<Attributes>().is_stream());
    for flag in Attributes::FLAGS {
        flag.set(unknown(), !flag.is_set(unknown()));
        keep(flag.word());
    }
});

entry!(own_list, {
    keep(Entry::<u32>::empty());
    keep(FunctionList::<Lent, u32>::new(unknown_slice(), unknown_slice()));
    let list: &mut FunctionList<Lent, ()> = unknown();
    keep(list.add_function(unknown(), *unknown(), *unknown()));
    keep(list.replace(unknown(), *unknown(), *unknown()));
    keep(list.add_signature(*unknown::<Signature<'static>>(), *unknown(), *unknown()));
    keep(list.replace_signature(*unknown::<Signature<'static>>(), *unknown(), *unknown()));
    keep(list.remove(unknown_text()));
    keep((list.find(unknown_text()), list.function(*unknown())));
    keep((list.generation(*unknown()), list.len(), list.is_empty()));
    keep(list.stopped());
    drain(list.iter());
});

entry!(their_list, {
    keep(TheirFunctionList::<Lent>::new(unknown_slice(), unknown_slice()));
    let list: &mut TheirFunctionList<Lent> = unknown();
    keep(list.remove(*unknown()));
    keep((list.find(unknown_text()), list.named(unknown_text()), list.function(*unknown())));
    keep((list.len(), list.is_empty(), list.skipped()));
    drain(list.iter());
    list.clear();
});

entry!(identities, {
    keep(Identity::m_unit(unknown_text(), *unknown()));
    keep(Identity::s_unit(unknown_text(), *unknown()));
    let (one, other): (&Identity, &Identity) = (unknown(), unknown());
    keep((one.name(), one.id(), one.role(), one.cmp(other), one == other));
});
