"""TensorFlow Lite files of one operator, written byte by byte by the public schema.fbs."""

import io
import struct
import zipfile

FLOAT32 = 0
UINT8 = 3
LOGISTIC = 14
RELU = 19


class Writer:
    """A FlatBuffer that grows at its end; every reference points forward."""

    def __init__(self):
        self.data = bytearray(8)

    def table(self, fields):
        """Append a table; `fields` are (struct type, value) or a function that appends what is referred to."""
        slots = max(fields, default=-1) + 1
        self.align()
        fields_at = len(self.data)
        self.data += struct.pack(f"<{2 + slots}H", 4 + 2 * slots, 0, *[0] * slots)
        self.align()
        at = len(self.data)
        self.data += struct.pack("<i", at - fields_at)
        references = []
        for slot, value in fields.items():
            struct.pack_into("<H", self.data, fields_at + 4 + 2 * slot, len(self.data) - at)
            if callable(value):
                references.append((len(self.data), value))
                self.data += bytes(4)
            else:
                kind, number = value
                self.data += struct.pack("<" + kind, number).ljust(4, b"\0")
        struct.pack_into("<H", self.data, fields_at + 2, len(self.data) - at)
        for place, append in references:
            self.refer(place, append())
        return at

    def tables(self, rows):
        """Append a vector of tables."""
        self.align()
        at = len(self.data)
        self.data += struct.pack("<I", len(rows)) + bytes(4 * len(rows))
        for index, fields in enumerate(rows):
            self.refer(at + 4 + 4 * index, self.table(fields))
        return at

    def numbers(self, values):
        """Append a vector of 32-bit integers."""
        self.align()
        at = len(self.data)
        self.data += struct.pack(f"<I{len(values)}i", len(values), *values)
        return at

    def text(self, value):
        """Append a text."""
        self.align()
        at = len(self.data)
        self.data += struct.pack("<I", len(value)) + value.encode() + b"\0"
        return at

    def align(self):
        self.data += bytes(-len(self.data) % 4)

    def refer(self, place, target):
        struct.pack_into("<I", self.data, place, target - place)


def tflite(
    *,
    inputs=((1, 24, 32, 3),),
    outputs=((1, 24, 32, 3),),
    operator=LOGISTIC,
    elements=FLOAT32,
    labels=("person", "dog", "cat"),
):
    """The bytes of a network whose first output is an operator of its first input; labels are appended as a zip."""
    writer = Writer()
    shapes = [*inputs, *outputs]
    tensors = [
        {
            0: lambda shape=shape: writer.numbers(shape),
            1: ("b", elements),
            2: ("I", 0),
            3: lambda index=index: writer.text(f"tensor_{index}"),
        }
        for index, shape in enumerate(shapes)
    ]
    numbers = list(range(len(shapes)))
    before = numbers[: len(inputs)]
    after = numbers[len(inputs) :]
    graph = {
        0: lambda: writer.tables(tensors),
        1: lambda: writer.numbers(before),
        2: lambda: writer.numbers(after),
        4: lambda: writer.text("main"),
        3: lambda: writer.tables(
            [
                {
                    0: ("I", 0),
                    1: lambda: writer.numbers(before[:1]),
                    2: lambda: writer.numbers(after[:1]),
                }
            ]
        ),
    }
    root = writer.table(
        {
            0: ("I", 3),
            1: lambda: writer.tables([{0: ("b", operator), 2: ("i", 1), 3: ("i", operator)}]),
            2: lambda: writer.tables([graph]),
            4: lambda: writer.tables([{}]),
        }
    )
    struct.pack_into("<I", writer.data, 0, root)
    writer.data[4:8] = b"TFL3"
    if not labels:
        return bytes(writer.data)
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w") as file:
        file.writestr("labels.txt", "\n".join(labels))
    return bytes(writer.data) + archive.getvalue()
