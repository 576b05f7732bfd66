"""One training on two machines: a learner, and actors that send it what they did.

An actor numbers its timesteps 1, 2, 3, ..., as its ring in the learner's replay does, and keeps
them in a file until a checkpoint of the learner holds them. After a lost connection or a restart of
either side the learner says which number it has, and the actor sends the next one.

    actor                                  learner
    step -> spool (file) ---- timesteps --> queue -> ring of the replay -> update -> checkpoint
         <------------------- stored, saved, weights ------------------------------/
"""
