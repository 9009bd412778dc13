"""Run work once: tasks in parallel, steps that are kept, one run at a time in an output folder.

    opening     open an output for one run: lock it, leave foreign files alone, repair what a killed run left
    workspace   which results of an output are complete, and which have to be computed;  ownership  who wrote a file
    room        the context in which one task runs, in steps
    pool        tasks in processes of this machine;  cluster  on the workers of a Dask cluster
    digests     fingerprints of what a result depends on: files, models, settings;  values  results as files, no pickle
"""
