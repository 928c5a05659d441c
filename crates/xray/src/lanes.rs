//! Loops over pixels that are compiled for each instruction set.

/// Declares a loop and its borrows; `Arch::dispatch` runs it. A closure is not enough: the compiler inlines
/// only small closures into the code for an instruction set, and compiles the others for the baseline CPU.
macro_rules! lanes {
    ($(#[$about:meta])* $name:ident { $($field:ident: $type:ty),* $(,)? } -> $output:ty $body:block) => {
        $(#[$about])*
        pub(crate) struct $name<'a> {
            $(pub(crate) $field: $type),*
        }

        impl pulp::WithSimd for $name<'_> {
            type Output = $output;

            #[inline(always)]
            fn with_simd<S: pulp::Simd>(self, _: S) -> $output {
                let Self { $($field),* } = self;
                $body
            }
        }
    };
}

pub(crate) use lanes;
