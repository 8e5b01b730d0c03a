"""Steps of lanes in compiled code, for models that offer ``CompiledTransitions``; ``virtual.environment`` is the
reference."""
