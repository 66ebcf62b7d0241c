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

/// The role of a parameter, which decides how it is kept and whether it decays.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Role {
    /// The weight of a linear layer, \[out, in\], or a convolution, \[out, in, taps\]; decays.
    Weight,
    /// Rows that are looked up by index, \[rows, channels\]; decays.
    Table,
    /// Biases, scales of norms, single vectors; does not decay.
    Vector,
    /// Rows that a nearest one is chosen from, \[rows, channels\]; learned by averages, not by gradients, and left alone
    /// by the optimizer.
    Code,
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

    /// Returns the list with layers that begin at zero drawn like all others of their kind:
    /// [`Init::fan_in`] of weight and bias. Norms and single vectors keep their zeros.
    ///
    /// A network whose last layer begins at zero says the same for every input until it has learned
    /// something; with this list its first weights are a random function of the input.
    #[must_use]
    pub fn without_zero_layers(mut self) -> Self {
        let is_zero = |parameter: &&Parameter| {
            parameter.role == Role::Weight && parameter.init == Init::Zeros
        };
        let layer = |parameter: &Parameter| {
            let inputs = parameter.shape.iter().skip(1).product();
            let name = parameter.name.strip_suffix("weight").unwrap_or(&parameter.name);
            (format!("{name}bias"), Init::fan_in(inputs))
        };
        let biases: BTreeMap<String, Init> = self.0.iter().filter(is_zero).map(layer).collect();
        for parameter in &mut self.0 {
            let (of_bias, of_weight) =
                (biases.get(&parameter.name), is_zero(&&*parameter).then(|| layer(parameter).1));
            if let Some(init) = of_bias.copied().or(of_weight) {
                parameter.init = init;
            }
        }
        self
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn layers_that_begin_at_zero_are_drawn_and_nothing_else_changes() {
        let mut list = ParameterList::default();
        let mut root = Scope::root(&mut list);
        let mut make = |name: &str, shape: &[usize], init, role| {
            root.parameter(name, shape, init, role);
        };
        make("in.weight", &[3, 5], Init::fan_in(5), Role::Weight);
        make("norm.bias", &[3], Init::Zeros, Role::Vector);
        make("null_context", &[7], Init::Zeros, Role::Vector);
        make("out.conv.weight", &[2, 3, 3], Init::Zeros, Role::Weight);
        make("out.conv.bias", &[2], Init::Zeros, Role::Vector);
        let drawn = list.clone().without_zero_layers();
        let inits: Vec<Init> = drawn.iter().map(|(_, parameter)| parameter.init).collect();
        let third = Init::Uniform { bound: 1.0 / 3.0 };
        assert_eq!(inits, [Init::fan_in(5), Init::Zeros, Init::Zeros, third, third]);
        let names = |list: &ParameterList| -> Vec<(String, Vec<usize>)> {
            list.iter().map(|(_, p)| (p.name.clone(), p.shape.clone())).collect()
        };
        assert_eq!(names(&drawn), names(&list));
    }
}
