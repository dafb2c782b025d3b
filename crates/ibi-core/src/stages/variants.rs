//! How the variants of a stage are declared.

/// Declares the closed set of a stage's variants: the enum, its names, its defaults, its range checks.
macro_rules! variants {
    ($(#[$doc:meta])* $name:ident { $($(#[$vdoc:meta])* $variant:ident = $word:literal,)+ }) => {
        $(#[$doc])*
        #[derive(Debug, Clone, PartialEq)]
        #[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
        #[cfg_attr(feature = "serde", serde(tag = "variant"))]
        #[non_exhaustive]
        pub enum $name {
            $($(#[$vdoc])* #[cfg_attr(feature = "serde", serde(rename = $word))] $variant($variant),)+
        }

        $(impl From<$variant> for $name {
            fn from(params: $variant) -> Self {
                Self::$variant(params)
            }
        })+

        impl $name {
            /// Every variant with its default parameters; what conformance tests and benches run over.
            #[must_use]
            pub fn all() -> Vec<Self> {
                vec![$(Self::$variant($variant::default()),)+]
            }

            /// The word that names the variant in parameter files, tables and Python.
            #[must_use]
            pub fn name(&self) -> &'static str {
                match self { $(Self::$variant(_) => $word,)+ }
            }

            pub(crate) fn check(&self) -> Result<(), $crate::error::Error> {
                match self { $(Self::$variant(params) => params.check(),)+ }
            }
        }
    };
}
pub(crate) use variants;
