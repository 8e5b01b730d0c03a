"""The XML files of an FMU: ``modelDescription.xml`` and ``sources/buildDescription.xml``."""

from __future__ import annotations

from xml.etree.ElementTree import Element, SubElement, indent, tostring

from surrogym_shared.fmu.block import TIME, Block, Variable

FMI = "3.0"
REFERENCE = 0  # value reference (FMI's number of a variable) of the time; variable i has i + 1


def model_description(block: Block) -> bytes:
    """Return the content of ``modelDescription.xml``."""
    root = Element(
        "fmiModelDescription",
        fmiVersion=FMI,
        modelName=block.name,
        instantiationToken=block.token,
        description=block.description,
        generationTool="Surrogym",
        variableNamingConvention="flat",
    )
    SubElement(
        root,
        "CoSimulation",
        modelIdentifier=block.identifier,
        canHandleVariableCommunicationStepSize="true",
        fixedInternalStepSize=repr(block.period),
        canGetAndSetFMUState="true",
        canSerializeFMUState="true",
    )
    if units := sorted({one.unit for one in block.variables} - {""}):
        definitions = SubElement(root, "UnitDefinitions")
        for name in units:
            unit = SubElement(definitions, "Unit", name=name)
            if name == "rad":
                SubElement(unit, "BaseUnit", rad="1")
    SubElement(SubElement(root, "LogCategories"), "Category", name="logStatusError", description="refused calls")
    experiment = SubElement(root, "DefaultExperiment", startTime="0.0", stepSize=repr(block.period))
    if block.stop is not None:
        experiment.set("stopTime", repr(block.stop))
    variables = SubElement(root, "ModelVariables")
    SubElement(
        variables,
        "Float64",
        name=TIME,
        valueReference=str(REFERENCE),
        causality="independent",
        variability="continuous",
    )
    for reference, one in enumerate(block.variables, REFERENCE + 1):
        _add(variables, one, reference)
    structure = SubElement(root, "ModelStructure")
    outputs = [(ref, one) for ref, one in enumerate(block.variables, REFERENCE + 1) if one.causality == "output"]
    for reference, _ in outputs:
        SubElement(structure, "Output", valueReference=str(reference))
    for reference, one in outputs:
        if one.start is None:
            SubElement(structure, "InitialUnknown", valueReference=str(reference))
    return _to_xml(root)


def _add(variables: Element, one: Variable, reference: int) -> None:
    entry = SubElement(variables, one.kind, name=one.name, valueReference=str(reference), causality=one.causality)
    if one.description:
        entry.set("description", one.description)
    if one.causality == "parameter":
        entry.set("variability", "fixed")
    elif one.kind != "Float64":
        entry.set("variability", "discrete")
    if one.causality != "input":
        entry.set("initial", "calculated" if one.start is None else "exact")
    if one.unit:
        entry.set("unit", one.unit)
    for key, value in (("min", one.low), ("max", one.high), ("start", one.start)):
        if value is not None:
            entry.set(key, _number(one, value))


def _number(one: Variable, value: float) -> str:
    match one.kind:
        case "Float64":
            return repr(float(value))
        case "Int32":
            return str(int(value))
        case "Boolean":
            return "true" if value else "false"


def build_description(block: Block, sources: list[str]) -> bytes:
    """Return the content of ``sources/buildDescription.xml``, with the names of the C files to compile."""
    root = Element("fmiBuildDescription", fmiVersion=FMI)
    configuration = SubElement(root, "BuildConfiguration", modelIdentifier=block.identifier)
    files = SubElement(configuration, "SourceFileSet", language="C99")
    for name in sources:
        SubElement(files, "SourceFile", name=name)
    return _to_xml(root)


def _to_xml(root: Element) -> bytes:
    indent(root)
    body: bytes = tostring(root, encoding="utf-8")
    return b'<?xml version="1.0" encoding="UTF-8"?>\n' + body + b"\n"
