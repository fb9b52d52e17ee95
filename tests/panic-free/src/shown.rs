//! What can be formatted, formatted.

use cara_core::distribution::function::Definition;
use cara_core::distribution::function_list::{FunctionList, TheirFunctionList};
use cara_core::distribution::identity::Identity;
use cara_core::distribution::name::{Shown, is_hidden};
use cara_core::error::{Constraint, Error};
use cara_core::storage::Lent;

use crate::linkage::{keep, show, unknown, unknown_text};

entry!(shown_errors, {
    show(unknown::<Error>());
    keep(unknown::<Constraint>().needs());
});

entry!(shown_definitions, {
    show(unknown::<Definition>());
});

entry!(shown_lists, {
    show(unknown::<FunctionList<Lent, ()>>().show_functions());
    show(unknown::<TheirFunctionList<Lent>>().show_functions());
});

entry!(shown_names, {
    show(Shown(unknown_text()));
    keep(is_hidden(*unknown()));
});

entry!(shown_identities, {
    show(unknown::<Identity>());
});
