"""All benchmarks in the order in which `all.py` runs them: what is run, its table, and what a reader has to know.

In arguments stand for paths: DATA the folder of real scans, C3D its recordings, MEN the model of 182 men and FOLD_0
that of the training poses of fold 0, both learned by the benchmarks before, SCRATCH a folder that is empty at first.
"""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import tables_completion as completion
import tables_mocap as mocap
import tables_models as models
import tables_scans as scans
import tables_statues as statues


@dataclass(frozen=True)
class Benchmark:
    """One script with its arguments.

    Attributes
    ----------
    name : str
        Of its result, `results/NAME.json`.
    title : str
    arguments : str
        The script and its arguments for the whole protocol.
    table : callable
        Makes the Markdown of a result.
    note : str
        What was measured on what, and where we lose. Figures stand in tables, where a run makes them.
    quick : str, optional
        The arguments with `--quick`; as `arguments` when not given, left out when empty.
    alone : bool
        It times whole commands on all cores, so nothing may run beside it.
    """

    name: str
    title: str
    arguments: str
    table: Callable[[dict], str]
    note: str = ""
    quick: str | None = None
    alone: bool = False


BENCHMARKS = (
    Benchmark("learning", "Learning from 71 poses and 182 people (SPRING-182/45)", "learning.py --keep MEN",
              models.learning,
              "The choice of parts included. Vertex PCA has no pose to adjust; with the pose held, only betas and "
              "place are fitted.", alone=True),
    Benchmark("threads", "Threads of whole commands, alone and beside one busy process", "threads.py --rounds 2",
              mocap.threads,
              "By the number of threads of the linear algebra; `own` is what scapekit decides. The busy process "
              "computes all the time on one of the cores.",
              quick="threads.py --threads own 2", alone=True),
    Benchmark("body_layer", "The models as layers of PyTorch", "body_layer.py people FOLD_0", models.body_layer,
              "One core, float32. `forward`: other betas for each body; `one person`: the same betas for all. The "
              "skinned reference has as many vertices, joints, betas and pose directions, anny its own model. `half`: "
              "large arrays in float16. Where we lose: batches of one; NumPy is faster there.",
              quick="body_layer.py people --batches 1 64"),
    Benchmark("folder", "A folder of scans", "folder.py SCRATCH", scans.folders,
              "Ten landmarks a scan. The largest memory is that of the one process, and of the largest worker.",
              quick="folder.py SCRATCH --scans 4 12 --workers 2 --different 4", alone=True),
    Benchmark("folder_of_1000", "A folder of a thousand scans: memory",
              "folder.py SCRATCH --scans 100 1000 --workers 2 --different 4 --faces 3000", scans.folders,
              "A template of 3,000 triangles, four scans under many names; other benchmarks may run beside it.",
              quick=""),
    Benchmark("cluster", "Folders of inputs on a cluster, one of its two workers killed",
              "cluster.py SCRATCH --count 100", scans.cluster,
              "Four inputs under many names, completed on a coarse model; recordings of 30 frames. Files of results "
              "are compared with those of this machine alone; `track` is killed in the middle of one recording and "
              "goes on. Other benchmarks may run beside it.",
              quick="cluster.py SCRATCH --count 6 --different 2"),
    Benchmark("mosh_speed", "How long `scape mosh` takes", "mosh_speed.py C3D -m MEN", mocap.speed,
              "Whole commands with all files and pages, on one thread; a synthetic person walks for a minute, "
              "without faults and with them. The paper: 7 minutes for a person, 1 s for the poses and 2 s for the "
              "soft tissue of a frame.",
              quick="mosh_speed.py C3D -m MEN --files 85_02", alone=True),
    Benchmark("mosh_memory", "Memory of `scape mosh` on ten minutes", "mosh_speed.py --minutes 10 --kinds walk",
              mocap.speed,
              "72,000 frames of 41 markers."),
    Benchmark("viewer_speed", "Sliders of a model in the browser", "viewer_speed.py -m MEN", completion.viewer_speed,
              "From a slider in the page to the new vertices there, without drawing. Chromium with software "
              "rendering.", alone=True),

    Benchmark("scape_5fold", "Held-out poses (SCAPE-5fold)", "scape_5fold.py --keep FOLD_0", models.poses,
              "Skeleton and model from the training poses of the fold alone. Seen on held-out poses while deciding: "
              "refinements on fold 0 and on coarse copies of folds 0 and 1; the width of blending on fold 1; that "
              "more parts help at all, on folds 1 and 3. A pose fit has three numbers a "
              "part, so some of the gain of more parts is freedom of the fit. Where we lose: deep squats and seated "
              "poses.",
              quick="scape_5fold.py --keep FOLD_0 --folds 0 --kinds LBS 'LBS + linear correctives' 'SCAPE, linear'"),
    Benchmark("population", "The built-in people against ANSUR II", "population.py --drawn 1000 --crossed 300",
              models.population,
              "The rows of the survey, for people made from three measures, are given with `--rows`. Where we lose: "
              "the weight of men (volume times 985 kg/m3), and skin that crosses itself somewhere in some people.",
              quick="population.py --drawn 60 --crossed 60"),
    Benchmark("built_in_people", "Strangers by the built-in people", "built_in_people.py", models.strangers,
              "The 45 held-out men of SPRING, seven landmarks. Where we lose: bellies that were not seen, as soldiers "
              "are leaner, and an arm that no camera saw.",
              quick="built_in_people.py --only 0 10 20 30 40"),
    Benchmark("mixed", "Learning from a random mix of synthetic people", "mixed.py", models.mixed,
              "30 people in 3 poses each against one person in many poses and others in one, as many meshes, with "
              "the true skeleton. Where we lose: time.",
              quick="mixed.py --seeds 1"),
    Benchmark("skeleton", "Skeletons", "skeleton.py", scans.skeletons,
              "Real poses have no truth: agreement is the adjusted Rand index of triangles. py-dem-bones is told the "
              "number of parts and finds no joints. Where we lose: to it in time.",
              quick="skeleton.py --only embedded real --seeds 2"),

    Benchmark("registration_10", "Registration, ten landmarks", "registration.py --set held --marks 10",
              scans.registration,
              "Virtual four-view scans, template mesh000, held-out poses and men. Where we lose: sharply bent limbs, "
              "whose skin slides; the surface is right long before the correspondence is. The men of the reference "
              "differ from ours by nearly the same displacement on every man, largest along the thighs, so part of "
              "their error may be the reference's."),
    Benchmark("registration_4", "Registration, four landmarks", "registration.py --set held --marks 4",
              scans.registration,
              "Hands and toes, and the built-in people. Where we lose: the deep squat of pose 7, which is told.",
              quick="registration.py --set held --marks 4 --poses 2,7,32 --men 2,97"),
    Benchmark("registration_0", "Registration without landmarks", "registration.py --set held --marks 0",
              scans.registration,
              "As `scape prep run` does without landmark files: through the built-in people, or by correspondences "
              "where these leave something to doubt. Where we lose: pose 7, whose forearms come out rolled (told), and "
              "men, whose thighs the reference has elsewhere.",
              quick="registration.py --set held --marks 0 --poses 2,7,32 --men 2,97"),
    Benchmark("registration_front", "Registration, one view from the front",
              "registration.py --set held --marks 10 --front", scans.registration,
              "Ten landmarks, of which some lie where there are no data.",
              quick="registration.py --set held --marks 10 --front --poses 2,32 --men 2"),
    Benchmark("registration_published", "The registration that SCAPE used, ten landmarks",
              "registration.py --set held --marks 10 --poses 22,2,32 --men 2 --published", scans.registration,
              "Rigid links between neighbours, matches point to point [Hahnel].",
              quick="registration.py --set held --marks 10 --poses 2 --men 2 --published"),
    Benchmark("peers", "Other registration tools on the same scans", "peers.py", scans.peers,
              "What each tool was given stands in the head of the script; a tool that is not installed is missing. "
              "Coherent point drift takes no landmarks and begins from the template placed by them. Parameters of "
              "functional maps and of drift were tried on one other scan, a handful each: their authors may do "
              "better. Where we lose: time, to accelerated drift.",
              quick="peers.py --bodies pose2,man52"),
    Benchmark("rolled_limbs", "Limbs rolled on purpose", "rolled_limbs.py --set held", scans.rolled_limbs,
              "Skin of a limb rolled about its bone on the true surface of a held-out pose. Counted is a doubt that "
              "the pose itself did not raise. Where we lose: half a right angle."),
    Benchmark("correspondences_7", "Correlated correspondence, seven seeds", "correspondences.py --set held --seeds 7",
              scans.correspondences,
              "Distances along the true body. Where we lose: pose 7, a deep squat. The figures are of the points "
              "with the least strain; the others are worse.",
              quick="correspondences.py --set held --seeds 7 --first 4"),
    Benchmark("correspondences_0", "Correlated correspondence without seeds",
              "correspondences.py --set held --seeds 0 --first 3", scans.correspondences,
              "In pose 7, where hands and feet are not the farthest ends, body and scan are matched upside down."),
    Benchmark("predicted_landmarks", "Landmarks predicted after four clicks", "predicted_landmarks.py --full",
              scans.predicted_landmarks,
              "What `scape pick` offers when hands and toes were clicked, without error, on a virtual scan. Where we "
              "lose: pose 7, where it means nothing, and men of another shape than the template.",
              quick="predicted_landmarks.py --poses 2,32,43,67 --men 2,52"),
    Benchmark("set_alone", "A set without landmarks that teaches itself", "set_alone.py SCRATCH --of animal",
              scans.set_alone,
              "An animal made for the tests, of which no built-in model knows anything: doubted scans are registered "
              "again through a model of those that are good. `--of poses` does it with SCAPE poses.",
              quick=""),
    Benchmark("reliability", "How well verdicts tell which registrations are right",
              "reliability.py SCRATCH --part held --count 90", scans.reliability,
              "Without landmarks; scans turned, upside down, with chair and floor, and cut at the waist among them. "
              "Right is within 20 mm on average and no part beyond 50 mm. Where we lose: men whose reference lies "
              "elsewhere are 20 to 24 mm off, and called good. Ten of its 82 scans were not run, eight with clutter.",
              quick=""),
    Benchmark("found_landmarks", "Landmarks of scans that nobody clicked", "found_landmarks.py SCRATCH",
              scans.found_landmarks,
              "`scape prep landmarks` with the template mesh000 on held-out poses of its person, on other men, and on "
              "poses seen from the front. Constants of expected errors were chosen on the tuning set. Where we lose: "
              "elbows of other men, knees that bend, and the trunk.",
              quick="found_landmarks.py SCRATCH --poses 2,17 --men 2 --fronts ''"),
    Benchmark("fronts", "The front of a body in pictures", "fronts.py", scans.fronts,
              "Against the level direction square to hips, shoulders and waist. The last column numbers the poses "
              "that are beyond 60 degrees."),
    Benchmark("signatures", "Where the skin belongs", "signatures.py", scans.signatures,
              "Mean curvature of the template and of the true posed surface at the places of its vertices, tuning "
              "poses. Ours lie some 10 mm from the reference, and by this measure nearer to where they belong: it "
              "cannot tell which is right to a few millimetres.",
              quick="signatures.py --poses 3,24"),
    Benchmark("coregistration", "Co-registration", "coregistration.py --held --landmarks 7 --rounds 2 --clickless 10",
              scans.coregistration,
              "Virtual scans of one man, ten poses held out from all tuning, on copies of 5,000 triangles. Skeleton "
              "and model come from these registrations alone. `failed`: more than 25 mm off on average.",
              quick=""),
    Benchmark("decimation", "Decimation of 400,000 triangles to 50,000", "decimation.py --only closed,open",
              scans.decimation,
              "A body subdivided twice, with relief. Where we lose: fast-simplification and pyfqmr are several times "
              "quicker.",
              quick="decimation.py --only closed"),
    Benchmark("decimated_set", "Decimation of a registered set", "decimation.py --only set", scans.decimated_set,
              "Learned on every second pose, measured on the others and on men. `slide`: how far a vertex moves "
              "along the skin, carried back to the template."),
    Benchmark("merging", "Merging four views", "cleaning.py --held --merge 2 --holes 0", scans.merging,
              "Virtual views with 2 mm noise of held-out poses and men. `trusted`: share of bodies whose alignment "
              "says of every view that it can be relied on; the others are not merged.",
              quick="cleaning.py --held --merge 1 --holes 0"),
    Benchmark("holes", "Six holes of a body", "cleaning.py --held --merge 0 --holes 2", scans.holes,
              "Crown, armpits, crotch and soles of real and synthetic bodies; pose000 was tuned on. `auto` is `fair` "
              "where no lines of sight are known. Where we lose: armpits; Poisson has no patch, as it remeshes "
              "everything.",
              quick="cleaning.py --held --merge 0 --holes 1"),

    Benchmark("half_views", "Half views of held-out poses, known subject, seven landmarks", "half_views.py -m FOLD_0",
              completion.half_views,
              "Fold 0, viewpoint not told; settings were chosen on fold 1. A part of which a fifth was seen counts "
              "as flipped when it is 100 mm off. Where we lose: fists that are turned about themselves, and an arm "
              "that no point of the scan touches."),
    Benchmark("half_views_blind", "The same without landmarks", "half_views.py -m FOLD_0 --marks 0",
              completion.half_views,
              "Where we lose: limbs that are wholly hidden, and a man who sits.",
              quick="half_views.py -m FOLD_0 --marks 0 --only 0 2 4 6 8 10 12"),
    Benchmark("half_views_published", "The same with the settings of the paper, seven landmarks",
              "half_views.py -m FOLD_0 --only 0 3 6 9 12 --published", completion.half_views,
              "Rotations, surface and shape in turns [SCAPE] Eq. 11.",
              quick="half_views.py -m FOLD_0 --only 0 6 --published"),
    Benchmark("half_people", "Half views of held-out men, unknown shape", "half_people.py -m MEN",
              completion.half_people,
              "45 men, seven landmarks; settings chosen on a dozen of the training men with a model without them."),
    Benchmark("half_people_peers", "The same beside simpler ways", "half_people.py -m MEN --peers",
              completion.half_people,
              "The nearest training body of 182 by trimmed closest points; bent: made the template of a pose-only "
              "model and fitted by our own solver. Poisson has no vertices in common with the truth.",
              quick="half_people.py -m MEN --peers --only 0 18 36"),
    Benchmark("few_scans", "Few scans: a model of 8 poses of one man and 10 men",
              "few_scans.py --models SCRATCH --stages poses men known unknown", completion.few_scans,
              "Three draws of training scans, leaning on the built-in people. `wrong`: the unseen surface off by more "
              "than 30 mm, or a part by more than 150 mm. Where we lose: limbs that nobody saw.",
              quick="few_scans.py --models SCRATCH --offsets 0 --only 0 2 4 6 8 10 12"),
    Benchmark("few_scans_fewest", "The same with one scan of one man",
              "few_scans.py --models SCRATCH --offsets 0 --poses 1 --men 1 --stages poses men known unknown",
              completion.few_scans, "Movement and people are those of the prior.", quick=""),
    Benchmark("depth_camera", "One picture of a depth camera",
              "depth_camera.py -m SCRATCH/model.npz --only 2 3 4 5 6 7 8 9 10 11 12 13 14 15", completion.depth_camera,
              "Dressed bodies before a wall, cut off by the border of the picture, unknown shape, a model of 43 "
              "poses and 46 men; tuned on other bodies, cameras and clothes. A part is seen when a fifth of its "
              "vertices is. Where we lose: limbs that the body hides, and legs of which the picture shows nothing.",
              quick="depth_camera.py -m SCRATCH/model.npz --only 2 3 4 5 6 --marks up"),
    Benchmark("wrong_landmarks", "Landmarks at wrong places", "wrong_landmarks.py -m FOLD_0",
              completion.wrong_landmarks,
              "Half views of held-out poses, known subject: as they are, exchanged, or one of them at the place of "
              "another. Told rightly: the body that is found without landmarks is far from the wrong ones alone.",
              quick="wrong_landmarks.py -m FOLD_0 --only 0 8"),
    Benchmark("wrong_inputs", "Verdicts on wrong inputs and on right ones", "wrong_inputs.py --folder SCRATCH",
              completion.verdicts,
              "Commands on files of synthetic people. Registration's limits on parts of a body, exchanged sides and "
              "stretch were set by some of them (seeds 100 and 209). Off on average and in the worst part is "
              "the body that was written, where the input has a right one: a wrong input may be mended.",
              quick="wrong_inputs.py --folder SCRATCH --only measure model"),
    Benchmark("worn_markers", "Markers clicked on a scan of the person who wears them", "worn_markers.py -m MEN",
              completion.worn_markers,
              "Seven landmarks, all clicks without error, `cmu41`. Where we lose: places on a limb that is rolled "
              "about its axis, and the trunk of bent bodies.",
              quick="worn_markers.py -m MEN --poses 2,17 --men 2 --people 2"),
    Benchmark("tracking", "Frames of points without markers", "tracking.py", completion.tracking,
              "A walk at 30 Hz of a synthetic person who is not in the model, two depth cameras with 5 mm noise, no "
              "landmarks. `surface`: the model's vertices to the true surface of the whole body."),
    Benchmark("imported_models", "Imported models beside SCAPE, on synthetic people not learned",
              "imported_models.py --star --smplx --frames 120 --bodies 3", completion.imported_models,
              "The pose columns of the STAR and SMPL-X layouts are noise here, and the latter's hands too: their "
              "distances say only that the fits end; the seconds are what counts.",
              quick="imported_models.py --frames 60 --bodies 1"),
    Benchmark("measures", "Measurements of people", "measures.py --bodies SCRATCH", completion.measures,
              "Synthetic people against sections of their true triangles by trimesh; scans of four views registered "
              "with ten landmarks, half views in random poses, 47 markers. Repeated: SPRING men, two scans each. The "
              "constants of stated errors were chosen on the even people. Where we lose: under-bust and chest girths "
              "of women, upper arms, and the trunk of an unknown person from one side.",
              quick="measures.py --bodies SCRATCH --people 4 --men 2"),

    Benchmark("markers", "Markers on random vertices of held-out poses, and real recordings",
              "markers.py -m FOLD_0 --c3d C3D --people MEN", completion.markers,
              "Fold 0, known subject. Every pose a frame of its own; a motion through these scans at 120 Hz, with "
              "markers missing, exchanged and astray; four recordings whose person comes from the markers. Where we "
              "lose: strays in the very first frame, and acrobatics.",
              quick="markers.py -m FOLD_0 --c3d C3D --people MEN --limit 300"),
    Benchmark("c3d", "Person and motion from real recordings", "c3d.py C3D -m MEN", completion.recordings,
              "One layout for four people, whose markers were moved by what was found over these same files; markers "
              "that the layout calls loose are sought on each person.",
              quick=""),
    Benchmark("mosh_people", "People from simulated markers alone", "mosh_people.py -m MEN --every 3", mocap.people,
              "45 held-out men with their own full shape; markers 5 mm beside their place, 12 frames. The patent: "
              "13.1 mm with 42 markers and 11.4 with 73, on scanned people. Where we lose: what betas say of posture "
              "differs between two sequences.",
              quick="mosh_people.py -m MEN --markers 47 --limit 15 --twice 15"),
    Benchmark("mosh_c3d", "Real recordings by MoSh, six markers held out", "mosh_c3d.py C3D -m MEN --soft",
              mocap.recordings,
              "35 of 41 markers. *Plain*: to where the layout has the held-out markers. *Calibrated*: the place of "
              "each is found from 12 frames, the error is that of all others. The weights of the poses were chosen "
              "on these files, as were the places of loose markers. The patent: 7.9 and 6.2 mm, held out 34 mm, on "
              "its data."),
    Benchmark("mosh_c3d_published", "The same with the weights of the patent",
              "mosh_c3d.py C3D -m MEN --preset published --soft", mocap.recordings,
              "No marker is an outlier, nothing is repaired; its prior of poses is that of 71 scans here.",
              quick=""),
    Benchmark("label_stream", "Labels while the points come in", "label_stream.py C3D", mocap.label_stream,
              "Person and marker places from the labels of the first half, then points alone, shuffled in every frame. "
              "Returns: five seconds away, back elsewhere, turned. Where we lose: a search stops the stream for about "
              "half a second; a hand or head that was found turned about, with a fifth of the points gone, may stay so "
              "for a second.",
              quick="label_stream.py C3D --files basketball --rates 120"),
    Benchmark("peer_markers", "Marker tracking by pymomentum on the same recordings", "peer_markers.py C3D -m MEN",
              mocap.peer_markers,
              "35 of 41 markers; the person or the calibration is in the time. pymomentum has the joints of our mean "
              "person, three rotations each, a length for every bone and our places of the markers; what else stands "
              "in the head of the script. It has no prior of shapes and poses, and a rig made by hand may do better. "
              "Its second row was chosen by the used and held-out markers of 01_01.c3d; the weights of our poses and "
              "our layout by the used markers of all four files."),
    Benchmark("mosh_soft", "Soft tissue of known size", "mosh_soft.py C3D -m MEN", mocap.soft_tissue,
              "Bumps of 6 to 12 cm that swing by 10 mm at 2 to 15 Hz, ten at a time, 1 mm of noise. 1 is the whole "
              "amplitude. Where we lose: bumps narrower than the distance of the markers, and 41 markers, which "
              "leave waist, buttocks and calves bare."),
    Benchmark("mosh_faults", "Faults put into markers",
              "mosh_artefacts.py C3D -m MEN --men 3 --held-out --no-real --files basketball 85_02", mocap.faults,
              "Held-out men moved as in two recordings; a tenth of the markers exchanged at any time, a twentieth "
              "out of sight. Thresholds were chosen on the recordings with faults put in.",
              quick="mosh_artefacts.py C3D -m MEN --men 1 --held-out --no-real --files basketball"),
    Benchmark("mosh_worn_elsewhere", "Markers worn elsewhere, and names exchanged throughout",
              "mosh_worn_elsewhere.py C3D -m MEN --first 20 --seeds 1", mocap.worn_elsewhere,
              "Every fourth frame of the recordings. Moved markers are simulated from the fitted body and what the "
              "marker was off it. Limits were chosen with other draws of these recordings.",
              quick="mosh_worn_elsewhere.py C3D -m MEN --first 20 --seeds 1 --files 85_02"),
    Benchmark("mosh_sex", "Sex from markers", "mosh_sex.py --models SCRATCH --strength 1 0.5 0.25", mocap.sex,
              "Synthetic people not learned from, 41 markers 5 mm off. Half and a quarter: people half way and less "
              "to the middle between the sexes.",
              quick="mosh_sex.py --models SCRATCH --count 12"),
    Benchmark("mosh_characters", "A motion on two cartoon figures", "mosh_characters.py --folder SCRATCH",
              mocap.characters,
              "Soft tissue twice. Triangles that turn over against the rotations of their parts. Where we lose: "
              "acrobatics turn over tens of triangles a frame.",
              quick=""),
    Benchmark("mosh_design", "Which markers to put on", "mosh_design.py -m MEN --men held-out", mocap.marker_sets,
              "45 held-out men in 8 poses, 114 symmetric candidates, left and right together.",
              quick=""),
    Benchmark("opensim_angles", "OpenSim's inverse kinematics on our TRC",
              "opensim_angles.py C3D/basketball.c3d --folder SCRATCH", mocap.opensim_angles,
              "OpenSim follows the markers with a model of our joint centres and sequences, ball joints everywhere, "
              "markers fixed to bones; ours has markers on the skin, outliers, smoothness and a prior."),
    Benchmark("other_programs", "What other programs make of our files", "other_programs.py --folder SCRATCH",
              mocap.other_programs,
              "Programs that are not installed are left out. Joints for BVH, else vertices."),

    Benchmark("statues", "Animated Statues",
              "statues.py DATA/scape_poses/mesh029.ply DATA/scape_poses/mesh038.ply DATA/spring_shapes/SPRING0028.ply "
              "DATA/spring_shapes/SPRING0199.ply --emboss", statues.statues,
              "No clicks; scans with known relief of 1 to 3 mm. Where we lose: fists and hands, folded against the "
              "mittens of the control mesh.",
              quick="statues.py DATA/scape_poses/mesh029.ply DATA/spring_shapes/SPRING0028.ply --emboss"),
    Benchmark("statue_fit", "Statues: fit of the control mesh", "statue_fit.py", statues.surface_fits,
              "Fig. 6 and 7 of the paper, then bodies from the same start. `published` are its Euler steps and its "
              "own slack; `register` the whole registration of scans, `settle` its last pass. Where we "
              "lose: time, to that pass alone."),
)
