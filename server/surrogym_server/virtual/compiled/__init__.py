"""Steps of lanes in compiled code, for models that offer ``CompiledSteps``; ``virtual.environment`` is the
reference."""
