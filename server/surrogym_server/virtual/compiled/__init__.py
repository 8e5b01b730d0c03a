"""Steps of lanes (parallel environments) in compiled code, for models that offer ``CompiledSteps``. The reference
implementation, in torch, is ``virtual.environment``."""
