//! What a network learns: names, shapes and first values of its parameters.

use std::collections::BTreeMap;

/// A parameter's place in its [`ParameterList`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct ParameterId(pub usize);

/// How a parameter is filled before training, as PyTorch does.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Init {
    Zeros,
    Ones,
    /// Uniform in ± bound.
    Uniform {
        bound: f64,
    },
    /// Normal with mean 0.
    Normal {
        deviation: f64,
    },
}

impl Init {
    /// U(−1/√fan_in, 1/√fan_in): PyTorch's default for weights and biases of linear layers and
    /// convolutions (Kaiming uniform with a = √5).
    pub fn fan_in(fan_in: usize) -> Self {
        Self::Uniform { bound: 1.0 / (fan_in as f64).sqrt() }
    }
}

/// What a parameter is, which decides how it is kept and whether it decays.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Role {
    /// The weight of a linear layer, \[out, in\], or a convolution, \[out, in, taps\]; decays.
    Weight,
    /// Rows that are looked up by index, \[rows, channels\]; decays.
    Table,
    /// Biases, scales of norms, single vectors; does not decay.
    Vector,
}

/// A parameter: its name in files, its shape as PyTorch has it, how it begins.
#[derive(Clone, Debug, PartialEq)]
pub struct Parameter {
    pub name: String,
    pub shape: Vec<usize>,
    pub init: Init,
    pub role: Role,
}

impl Parameter {
    /// Returns the number of elements.
    pub fn len(&self) -> usize {
        self.shape.iter().product()
    }

    /// Returns whether there are no elements.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

/// All parameters of a network, in the order in which its layers were made.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ParameterList(Vec<Parameter>);

impl ParameterList {
    /// Adds a parameter.
    ///
    /// # Panics
    /// If the name is taken: two layers of a network would share a place in its files.
    pub fn add(&mut self, parameter: Parameter) -> ParameterId {
        let taken = self.0.iter().any(|other| other.name == parameter.name);
        assert!(!taken, "parameter {} exists already", parameter.name);
        self.0.push(parameter);
        ParameterId(self.0.len() - 1)
    }

    /// Returns a parameter.
    pub fn get(&self, id: ParameterId) -> &Parameter {
        &self.0[id.0]
    }

    /// Returns all parameters with their places.
    pub fn iter(&self) -> impl ExactSizeIterator<Item = (ParameterId, &Parameter)> {
        self.0.iter().enumerate().map(|(i, parameter)| (ParameterId(i), parameter))
    }

    /// Returns places by name.
    pub fn by_name(&self) -> BTreeMap<&str, ParameterId> {
        self.iter().map(|(id, parameter)| (parameter.name.as_str(), id)).collect()
    }

    /// Returns the number of parameters, each a tensor.
    pub fn len(&self) -> usize {
        self.0.len()
    }

    /// Returns whether there are none.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// Returns the number of elements of all parameters.
    pub fn n_elements(&self) -> usize {
        self.0.iter().map(Parameter::len).sum()
    }
}

/// A place in a network where parameters are made: the list, and the path of names to here.
pub struct Scope<'a> {
    list: &'a mut ParameterList,
    path: String,
}

impl<'a> Scope<'a> {
    /// Returns the root.
    pub fn root(list: &'a mut ParameterList) -> Self {
        Self { list, path: String::new() }
    }

    /// Returns the place of a part.
    pub fn at(&mut self, part: impl AsRef<str>) -> Scope<'_> {
        let part = part.as_ref();
        let path =
            if self.path.is_empty() { part.to_owned() } else { format!("{}.{part}", self.path) };
        Scope { list: self.list, path }
    }

    /// Makes a parameter called `name` here.
    pub fn parameter(
        &mut self,
        name: &str,
        shape: &[usize],
        init: Init,
        role: Role,
    ) -> ParameterId {
        let name = self.at(name).path;
        self.list.add(Parameter { name, shape: shape.to_vec(), init, role })
    }
}
