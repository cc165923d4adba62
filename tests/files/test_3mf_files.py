"""3MF packages, written here part by part, and compared with the arrays that they were written from."""

import io
import warnings
import zipfile

import numpy as np
import pytest
from mesh_3mf import DOCTYPE_BOMB, PRODUCTION, bomb, chain, nested, triangle_3mf
from mesh_files import check_refused, linear, write

import edgegrad as eg

pytestmark = pytest.mark.unsanitized

MICROSOFT = "http://schemas.microsoft.com/3dmanufacturing"
SPACES = (
    f'xmlns="{MICROSOFT}/core/2015/02" xmlns:p="{MICROSOFT}/production/2015/06" xmlns:m="{MICROSOFT}/material/2015/02" '
    'xmlns:acme="http://acme.example/3mf"'
)
CORNERS = np.array([[0, 0, 0], [2, 0, 0], [0, 3, 0], [0, 0, 1]], float)
FACES = np.array([[0, 1, 2], [0, 3, 1]])


def mesh(corners=CORNERS, faces=FACES, of_faces=("", "")):
    vertices = "".join('<vertex x="{}" y="{}" z="{}"/>'.format(*v) for v in np.asarray(corners).tolist())
    triangles = "".join(
        '<triangle v1="{}" v2="{}" v3="{}" {}/>'.format(*f, more)
        for f, more in zip(faces.tolist(), of_faces, strict=True)
    )
    return f"<mesh><vertices>{vertices}</vertices><triangles>{triangles}</triangles></mesh>"


def one(inside, id=1, more=""):
    return f'<object id="{id}" type="model" {more}>{inside}</object>'


def model(resources="", build="", more="", space=SPACES):
    return f"<model {space} {more}><resources>{resources}</resources><build>{build}</build></model>"


def save(folder, parts):
    """Write a package of such files; a single text is its root."""
    parts = {"3D/3dmodel.model": parts} if isinstance(parts, str) else parts
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for name, text in parts.items():
            archive.writestr(name, text)
    (folder / "a.3mf").write_bytes(stream.getvalue())
    return folder / "a.3mf"


def shown(path, **options):
    """Return the corners (F, 3, 3) of each mesh of a scene that loads without a warning."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return [m.verts[m.faces].numpy() for m in eg.load_scene(path, **options).meshes]


def expect(found, *corners):
    assert len(found) == len(corners)
    for a, b in zip(found, corners, strict=True):
        np.testing.assert_allclose(a, np.asarray(b)[FACES], atol=1e-6)


def test_objects_that_share_an_id_in_different_parts(tmp_path):
    """Components and items have a path, which names parts whatever its case."""
    parts = {
        "3D/3dmodel.model": model(
            one('<components><component objectid="1" p:path="/3D/Objects/a.model"/><component objectid="1" '
                'p:path="/3d/objects/B.model" transform="1 0 0 0 1 0 0 0 1 0 0 7"/></components>'),
            '<item objectid="1"/><item objectid="1" p:path="/3D/Objects/b%2emodel" transform="2 0 0 0 2 0 0 0 2 1 1 1"/>',
        ),
        "3D/Objects/a.model": model(one(mesh())),
        "3D/Objects/b.model": model(one(mesh(CORNERS * 5), 1) + one(mesh(CORNERS * 9), 2)),
    }  # fmt: skip
    path = save(tmp_path, parts)
    expect(shown(path), CORNERS, CORNERS * 5 + [0, 0, 7], CORNERS * 10 + 1)
    assert eg.load_mesh(path).faces.shape == (6, 3)


def test_the_root_is_the_part_that_the_package_names(tmp_path):
    relation = f'<Relationship Type="{MICROSOFT}/2013/01/3dmodel" Target="/other/main.model" Id="r"/>'
    parts = {
        "3D/3dmodel.model": model(one(mesh()), '<item objectid="1"/>'),
        "other/main.model": model(one(mesh(CORNERS + 4)), '<item objectid="1"/>'),
        "_rels/.rels": f"<Relationships xmlns='http://schemas.openxmlformats.org/package/2006/relationships'>{relation}</Relationships>",
    }
    expect(shown(save(tmp_path, parts)), CORNERS + 4)


def test_units_are_the_file_s_own(tmp_path):
    """The root's units count. Parts in others are converted to them."""
    expect(shown(save(tmp_path, model(one(mesh()), '<item objectid="1"/>', 'unit="inch"'))), CORNERS)
    parts = {
        "3D/3dmodel.model": model(build='<item objectid="1" p:path="/b.model" transform="1 0 0 0 1 0 0 0 1 3 0 0"/>'),
        "b.model": model(one(mesh()), more='unit="inch"'),
    }
    expect(shown(save(tmp_path, parts)), CORNERS * 25.4 + [3, 0, 0])


GROUPS = (
    '<basematerials id="5"><base name="a" displaycolor="#FF0000"/><base name="b" displaycolor="#3366ff"/></basematerials>'
    '<m:colorgroup id="6"><m:color color="#00FF00"/><m:color color="#808040"/><m:color color="#3366FFFF"/></m:colorgroup>'
)
RED, SKY, GREEN, OLIVE = ([255, 0, 0], [51, 102, 255], [0, 255, 0], [128, 128, 64])


@pytest.mark.parametrize(
    ("of_object", "of_faces", "expected"),
    [
        ('pid="5" pindex="1"', ("", 'pid="6" p1="1"'), [SKY, OLIVE]),
        ('pid="5" pindex="0"', ('p1="1"', ""), [SKY, RED]),
        ("", ('pid="6" p1="0"', 'pid="5" p1="0"'), [GREEN, RED]),
    ],
)
def test_colours_of_faces(tmp_path, of_object, of_faces, expected):
    path = save(tmp_path, model(GROUPS + one(mesh(of_faces=of_faces), more=of_object), '<item objectid="1"/>'))
    np.testing.assert_allclose(eg.load_mesh(path).face_colors, linear(expected), atol=1e-6)
    assert eg.load_mesh(path, materials=False).channels is None
    assert eg.load_mesh(path, lit=True).material is not None
    expect(shown(path), CORNERS)


def test_colours_of_corners(tmp_path):
    of_faces = ('pid="6" p1="0" p2="1" p3="2"', 'pid="5" p1="0"')
    loaded = eg.load_mesh(save(tmp_path, model(GROUPS + one(mesh(of_faces=of_faces)), '<item objectid="1"/>')))
    assert loaded.verts.shape == (4, 3)
    np.testing.assert_allclose(loaded.corner_colors, linear([[GREEN, OLIVE, SKY], [RED] * 3]), atol=1e-6)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (model(one(mesh()), '<item objectid="1"/>', 'acme:speed="3"'), "attribute speed of model (left out)"),
        (model(one(mesh()), '<item objectid="1"/><acme:heat/>'), "element acme:heat (left out)"),
        (
            model(one(mesh()) + "<m:texture2d><m:x/></m:texture2d>", '<item objectid="1"/>'),
            "element m:texture2d (left out)",
        ),
        (
            model(one(mesh(of_faces=('paint_color="4"', ""))), '<item objectid="1"/>'),
            "attribute paint_color of triangle (left out)",
        ),
        (
            model(GROUPS + one(mesh(of_faces=('pid="5" p1="0"', ""))), '<item objectid="1"/>'),
            "triangles without a colour beside others with one (white)",
        ),
        (model(one(mesh(), more='pid="7" pindex="0"'), '<item objectid="1"/>'), "pid 7 (no such group)"),
        (
            model(GROUPS + one(mesh(), more='pid="5"'), '<item objectid="1"/>'),
            "pid of an object without pindex (left out)",
        ),
        (
            model(GROUPS + one(mesh(of_faces=('pid="5"', ""))), '<item objectid="1"/>'),
            "pid of a triangle without p1 (left out)",
        ),
        (
            model(GROUPS + one(mesh(of_faces=('p1="0"', ""))), '<item objectid="1"/>'),
            "p1 of a triangle without pid (left out)",
        ),
        (
            model(
                GROUPS.replace("#00FF00", "#00FF0080") + one(mesh(), more='pid="6" pindex="0"'), '<item objectid="1"/>'
            ),
            "alpha of colours (left out)",
        ),
    ],
)
def test_one_unread_thing_is_named(tmp_path, text, said):
    path = save(tmp_path, text)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        eg.load_scene(path)
    assert [str(warning.message) for warning in caught] == [f"{path}: not rendered as the file asks: {said}"]


def test_what_changes_no_picture_is_not_named(tmp_path):
    harmless = (
        '<metadata name="Title"><acme:x/></metadata><metadatagroup><metadata name="a">b</metadata></metadatagroup>'
    )
    text = model(one(mesh(), more='partnumber="3" thumbnail="/a.png" p:UUID="1"'), '<item objectid="1" p:UUID="2"/>')
    text = text.replace("<resources>", f"<!-- a --><?b c?>{harmless}<resources>")
    path = save(tmp_path, {"3D/3dmodel.model": text, "Metadata/thumbnail.svg": "<!DOCTYPE svg>"})
    expect(shown(path), CORNERS)


@pytest.mark.parametrize(
    ("content", "fault"),
    [
        (
            triangle_3mf({"<model": f'<!DOCTYPE a [<!ENTITY l0 "0">{DOCTYPE_BOMB}]><model', 'x="0"': 'x="&l9;"'}),
            "without a DOCTYPE",
        ),
        (triangle_3mf({"<model": '<!DOCTYPE a [<!ENTITY s SYSTEM "file:///etc/passwd">]><model'}), "without a DOCTYPE"),
        (triangle_3mf({"<model": '<!DOCTYPE a SYSTEM "http://127.0.0.1:9/a.dtd"><model'}), "without a DOCTYPE"),
        (
            triangle_3mf(
                {'item objectid="1"': f'item objectid="1" xmlns:p="{PRODUCTION}" p:path="/3D/other.model"'},
                {"3D/other.model": '<!DOCTYPE a SYSTEM "a.dtd"><model/>'},
            ),
            r"in '3d/other\.model'",
        ),
        (triangle_3mf(nested(38)), "at most 100000 instances of objects, got 274877906944"),
        (triangle_3mf(chain(100)), "nested up to 64 times, got more"),
        (
            triangle_3mf({
                "</resources>": '<object id="2"><components><component objectid="2"/></components></object></resources>',
                'item objectid="1"': 'item objectid="2"',
            }),
            "object 2 inside itself",
        ),
        (triangle_3mf({'item objectid="1"': 'item objectid="7"'}), "an object with the id 7 in '3d/3dmodel.model', got none"),
        (
            triangle_3mf({'<vertex x="1"': '<vertex w="1"'}),
            "the attributes x, y and z of each vertex of object 1, got one without 'x'",
        ),
        (triangle_3mf({'<vertex x="1"': '<vertex x="1,5"'}), "numbers alone in x, y and z of each vertex of object 1, got '1,5'"),
        (triangle_3mf({'v3="2"': 'v3="9"'}), "indices from 0 to 2, got 9"),
        (triangle_3mf({"</build>": ""}), "cannot be read"),
        (triangle_3mf()[:-30], "cannot be read"),
        (bomb(70), "an archive that grows up to 100 times"),
        (
            model(one(mesh()), '<item objectid="1"/>', 'requiredextensions="p acme"'),
            r"got one that needs http://acme\.example/3mf; export it without",
        ),
        (model(one(mesh()), '<item objectid="1" p:path="/3D/b.model"/>'), "the model part '3d/b.model', got none"),
        (model(one(mesh()), '<item objectid="1" transform="1 0 0"/>'), "12 numbers for a transform, got 3"),
        (model(one(mesh()), '<item objectid="1"/>', 'unit="parsec"'), "a unit of 3MF .*, got 'parsec'"),
        (
            model(GROUPS + one(mesh(), more='pid="5" pindex="2"'), '<item objectid="1"/>'),
            r"colours from 0 to 1 of group 5, got \[2, 2, 2\]",
        ),
        (model(GROUPS.replace("#FF0000", "red") + one(mesh()), '<item objectid="1"/>'), "#RRGGBB or #RRGGBBAA, got 'red'"),
        (
            model(GROUPS + one(mesh(), more='pid="5" pindex="x"'), '<item objectid="1"/>'),
            "whole numbers for colours of group 5, got x, x, x",
        ),
        (model(one(mesh()).replace('id="1"', ""), '<item objectid="1"/>'), "attribute id of each object in .*, got one without"),
        (model(one(mesh()), "<item/>"), "attribute objectid of each item and component, got one without"),
        (model(one(mesh())), "expected items in the build, which say what is shown, got none"),
        (
            model(GROUPS + one(mesh(CORNERS, FACES - 1, ('pid="6" p1="0" p2="1"',) * 2)), '<item objectid="1"/>'),
            "indices from 0 to 3, got -1",
        ),
        (model(one(mesh()) * 2, '<item objectid="1"/>'), "an id for each object, got '1' for two in '3d/3dmodel.model'"),
        (model(one(mesh()), '<item objectid="1"/>', space='xmlns="a"'), "a model of 3MF in .*, got '{a}model'"),
    ],
)  # fmt: skip
def test_malformed_files_are_refused_by_name(tmp_path, content, fault):
    path = save(tmp_path, content) if isinstance(content, str) else write(tmp_path, "a.3mf", content)
    assert path.stat().st_size < 200_000
    check_refused(path, fault)
